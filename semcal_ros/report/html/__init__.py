"""Self-contained HTML pages: images and styles are embedded."""

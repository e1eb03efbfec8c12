"""HTML pages that hold their own pictures and styles."""

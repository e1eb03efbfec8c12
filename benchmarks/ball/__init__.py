"""What makes a reconstructed ball too small, and whether its interval holds the truth."""

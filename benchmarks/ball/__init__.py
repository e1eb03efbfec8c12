"""What makes a reconstructed ball too small."""

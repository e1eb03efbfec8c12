"""JSON schemas of the project's files."""

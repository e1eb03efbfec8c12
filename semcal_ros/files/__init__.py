"""Recordings, vendor images and files on disk."""

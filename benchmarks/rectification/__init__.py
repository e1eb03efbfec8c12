"""Rectification beside a bare remap."""

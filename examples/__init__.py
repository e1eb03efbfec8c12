"""Examples, a folder each: ``python -m examples.cantilever`` from the root of the repository."""

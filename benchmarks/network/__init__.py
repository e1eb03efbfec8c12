"""The suite on several machines: network namespaces that are joined by virtual cables."""

"""Work in separate processes beside a node."""

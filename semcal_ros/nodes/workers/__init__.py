"""Work in processes of its own beside a node."""

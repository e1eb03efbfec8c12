"""What a command, a node and a notebook have in common: recordings in, results out."""

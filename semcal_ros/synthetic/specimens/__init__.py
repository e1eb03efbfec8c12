"""The specimens of the virtual SEM: grid, gold on carbon, target, cantilever, ball."""

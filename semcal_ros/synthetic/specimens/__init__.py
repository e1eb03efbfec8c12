"""What the virtual SEM looks at: grid, gold on carbon, target, cantilever, ball."""

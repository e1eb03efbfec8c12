"""Applications of the method: bending of a cantilever, shape from views, visual servoing."""

"""Visual servoing of the stage."""

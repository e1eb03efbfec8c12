"""Shape of a ball on a tip."""

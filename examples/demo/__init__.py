"""The whole suite at work; ``make demo`` runs it."""

"""Gyros: means of their rates over dwells and turns, and what the part truly turned meanwhile."""

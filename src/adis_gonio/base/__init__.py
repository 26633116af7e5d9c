"""Foundations: errors, numbers with units and uncertainty, output files, JSON, a budget of time."""

"""Residual → effect → better model."""

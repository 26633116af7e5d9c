"""The angle while the part moves: smoothing and live readings."""

"""Find slipped, mistyped and swapped positions: compare declared angles with gravity and the gyro."""

"""Gyros: mean rates over dwells and turns, true rotations of the sensor, and fits of both."""

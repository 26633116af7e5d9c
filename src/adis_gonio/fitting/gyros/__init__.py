"""Gyros: mean rates over dwells and turns, the true rotation of the part, and fits of both."""

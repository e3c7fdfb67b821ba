"""Front and rear cameras without OpenGL, and a map from above, for every task."""

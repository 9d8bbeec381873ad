"""Where the camera is: Gauss-Newton on the field, and the checks a pose must pass."""

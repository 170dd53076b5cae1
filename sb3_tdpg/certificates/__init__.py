"""Certificates: upper bounds on the expected cost under a declared shift of the sensor or the start."""

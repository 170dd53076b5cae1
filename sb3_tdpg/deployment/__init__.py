"""From a policy to the robot: one step in a file that needs neither this package nor PyTorch."""

"""Hyperparameter files for rl-zoo3, one YAML file per algorithm."""

"""Experiments: from a block of settings to trained and evaluated models on disk, resumable, on one machine or many."""

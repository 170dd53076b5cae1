"""Shared helpers: networks with weights per time step, running norms, files, provenance, threads and processes."""

"""Shared helpers, such as networks with weights per time step, running norms, files, threads and processes."""

"""What every room uses: networks with weights per step, running norms, files, provenance, threads, processes."""

"""What every room uses: files that are never half-written, provenance, threads, processes."""

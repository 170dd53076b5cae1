"""The paper's experiments, from training to tables and figures."""

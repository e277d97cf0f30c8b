"""Pictures of patterns, convergence and corrections, for reports and scripts."""

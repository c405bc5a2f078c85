"""Pictures of runs. Matplotlib is imported only when one is drawn."""

"""Training: run folders, collectors, and one file for each thing that learns."""

"""Datasets for learning elsewhere: runs of a scenario as Parquet and as TensorDict memmaps."""

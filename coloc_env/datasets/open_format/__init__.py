"""The open recording format: read and written."""

from coloc_env.datasets.open_format.description import FILE
from coloc_env.datasets.open_format.reader import read_recording
from coloc_env.datasets.open_format.writer import write_recording

__all__ = ["FILE", "read_recording", "write_recording"]

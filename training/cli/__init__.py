"""The ``coloc`` command."""

"""coloc's training and evaluation: whatever runs agents in worlds, and the ``coloc`` command."""

from coloc_env._command import require_own_packages

require_own_packages()

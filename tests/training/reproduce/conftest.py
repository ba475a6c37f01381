"""What tests of studies share can be imported, also by processes that they start."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

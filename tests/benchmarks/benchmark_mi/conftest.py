"""Make the modules beside the scripts importable, as they are for the scripts."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

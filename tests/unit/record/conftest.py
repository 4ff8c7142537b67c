import sys
from pathlib import Path

# the checker and the stand-in for the loop are shared with the fault tests
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "faults"))

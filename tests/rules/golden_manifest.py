"""Hashes of the data that tests and runs compare with, in tests/golden/manifest.json.

    python tests/rules/golden_manifest.py          write the manifest anew (after a change that was meant; say why in the commit)

Each entry: sha256, size, how the file came about. A new file needs an entry here with its origin.
"""

import hashlib
import json
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
MANIFEST = ROOT / "tests" / "golden" / "manifest.json"
# pattern → how such a file is made or where it comes from
ORIGINS = {
    "firmware_iface/golden_frames.csv": "by hand from actuator.dbc; each row names its source",
    "firmware_iface/actuator.dbc": "by hand; axes 2 to 4 by firmware_iface/make_axes.py",
    "profiles/models/*": "hilrunner train; recipe, seed and versions are in the data sheet beside the model",
    "tests/golden/*.csv": "named in the file's head",
    "tests/golden/*.npz": "named in the test that reads it",
    "tests/replay/*.mcap": "recorded by hilrunner; settings are in the log's metadata",
}


def golden_files() -> dict[str, str]:
    """Path relative to the project → origin, for every file that must not change by itself."""
    found = {}
    for pattern, origin in ORIGINS.items():
        for path in sorted(ROOT.glob(pattern)):
            if path.is_file() and path != MANIFEST:
                found[str(path.relative_to(ROOT))] = origin
    return found


def entry(path: Path, origin: str) -> dict:
    """What the manifest says of a file."""
    data = path.read_bytes()
    return {"sha256": hashlib.sha256(data).hexdigest(), "size_bytes": len(data), "origin": origin}


def differences(manifest: dict[str, dict], root: Path = ROOT) -> list[str]:
    """What does not agree with the manifest: missing, empty, changed or unlisted files."""
    found = []
    for name, said in manifest.items():
        path = root / name
        if not path.is_file():
            found.append(f"{name}: missing")
        elif path.stat().st_size == 0:
            found.append(f"{name}: empty")
        elif entry(path, said["origin"]) != said:
            found.append(f"{name}: changed")
    found += [f"{name}: not in the manifest" for name in golden_files() if root == ROOT and name not in manifest]
    return found


def main() -> None:
    """Write the manifest."""
    manifest = {name: entry(ROOT / name, origin) for name, origin in golden_files().items()}
    MANIFEST.write_text(json.dumps(manifest, indent=1, sort_keys=True) + "\n")
    print(f"{MANIFEST.relative_to(ROOT)}: {len(manifest)} files")


if __name__ == "__main__":
    main()

"""Maps the data folders of the source tree into the wheel; everything else about packaging is in pyproject.toml."""

from setuptools import find_packages, setup

DATA = {
    "profiles": [
        "*.toml",
        "*.md",
        "models/*",
        "layouts/*",
        "**/*.toml",
        "**/*.csv",
        "**/*.json",
        "**/*.md",
        "*.csv",
        "*.json",
    ],
    "firmware_iface": ["*.dbc", "*.csv", "*.md", "*.toml", "c/*.[ch]", "c/**/*.[ch]", "c/Makefile", "c/*.md"],
    "systemd": ["*"],
}
PLACES = {"systemd": "tools/systemd"}  # where a folder is not at the top of the tree

setup(
    packages=find_packages(include=["hilrunner", "hilrunner.*"]) + [f"hilrunner._data.{name}" for name in DATA],
    package_dir={f"hilrunner._data.{name}": PLACES.get(name, name) for name in DATA},
    package_data={
        **{f"hilrunner._data.{name}": patterns for name, patterns in DATA.items()},
        "hilrunner.evidence": ["page.css"],
        "hilrunner.labs": ["*.c"],
        "hilrunner.virtual": ["c/*.[ch]"],
    },
    include_package_data=False,
)

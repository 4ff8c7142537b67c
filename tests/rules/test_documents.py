"""What the README and `--help` promise agrees with the code; lock files agree with pyproject.toml; links lead somewhere."""

import re
import tomllib
from importlib import import_module

import msgspec
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from hilrunner import cli
from hilrunner.base import exit_codes
from hilrunner.setup import profile_page
from hilrunner.setup.profile_errors import metas
from tests.rules import tree

README = (tree.ROOT / "README.md").read_text()


def _codes_in_code():
    return sorted(value for name, value in vars(exit_codes).items() if name.isupper() and isinstance(value, int))


def test_exit_codes_agree_in_readme_help_and_code():
    rows = re.findall(r"^\| (\d) \| (.+?) \|$", README, re.MULTILINE)
    assert [int(code) for code, _ in rows] == _codes_in_code()
    help_codes = sorted(int(code) for code in re.findall(r"(?:^|\s)(\d) ", cli.EXIT_CODES))
    assert help_codes == _codes_in_code()


def test_every_command_has_its_file_and_stands_in_the_readme():
    for command in cli.COMMANDS:
        module = import_module(f"hilrunner.commands.{command.replace('-', '_')}")
        assert callable(module.add_arguments)
        assert callable(module.main)
        assert module.__doc__
        assert f"hilrunner {command}" in README or command == "run"


def test_links_lead_to_files():
    for path in tree.project_files():
        if path.suffix != ".md":
            continue
        for target in re.findall(r"\]\((?!https?://|#|mailto:)([^)\s#]+)", tree.text_of(path)):
            assert (path.parent / target).exists(), f"{tree.relative(path)}: {target}"


def _pins(name):
    lines = [line for line in (tree.ROOT / name).read_text().splitlines() if line and not line.startswith("#")]
    assert all(re.fullmatch(r"[a-z0-9-]+==[0-9][0-9A-Za-z.]*", line) for line in lines), f"{name}: name==version only"
    return dict(line.split("==") for line in lines)


def test_lock_files_satisfy_the_declared_dependencies():
    project = tomllib.loads((tree.ROOT / "pyproject.toml").read_text())["project"]
    runtime = _pins("requirements.lock")
    development = _pins("requirements-dev.lock")
    assert not set(runtime) & set(development)
    extras = [line for group in project["optional-dependencies"].values() for line in group]
    for lines, pins in ((project["dependencies"], runtime), (extras, runtime | development)):
        for requirement in map(Requirement, lines):
            version = pins.get(canonicalize_name(requirement.name))
            assert version is not None, f"{requirement}: not in the lock file; run `make lock`"
            assert requirement.specifier.contains(version, prereleases=True), f"{requirement}: {version} is locked"


def test_the_page_of_profile_keys_is_what_the_format_says():
    text = (tree.ROOT / "docs" / "profiles.md").read_text("utf-8")
    assert text == profile_page.page(), "run tools/profile_keys --write"


def test_every_profile_key_has_a_unit_and_a_meaning():
    for _, _, struct in profile_page._TABLES:
        for one in msgspec.structs.fields(struct):
            told = [meta.description for meta in metas(one.type) if meta.description]
            assert told, f"{struct.__name__}.{one.encode_name}: Meta(description=...) is what docs/profiles.md prints"
    keys = ("offset_mmps", "relief_mm3ps_mpa", "valve_pa_mm3ps_sqrtmpa", "gain")
    assert [profile_page.unit_of(key) for key in keys] == ["mm/s", "mm^3/s/MPa", "mm^3/s/MPa^0.5", ""]

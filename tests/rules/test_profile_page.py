"""docs/profiles.md is what `tools/profile_keys` prints, and every key of the format has a meaning there."""

import msgspec

from hilrunner.setup.profile_errors import metas
from hilrunner.setup.profile_page import _TABLES, page, unit_of
from tests.rules import tree


def test_the_page_is_what_the_format_says():
    text = (tree.ROOT / "docs" / "profiles.md").read_text("utf-8")
    assert text == page(), "run tools/profile_keys --write"


def test_every_key_has_a_meaning():
    for _, _, struct in _TABLES:
        for one in msgspec.structs.fields(struct):
            assert any(meta.description for meta in metas(one.type)), f"{struct.__name__}.{one.encode_name}"


def test_units_come_from_the_end_of_a_key():
    assert [unit_of(key) for key in ("offset_mmps", "relief_mm3ps_mpa", "valve_pa_mm3ps_sqrtmpa", "gain")] == [
        "mm/s", "mm^3/s/MPa", "mm^3/s/MPa^0.5", "",
    ]  # fmt: skip

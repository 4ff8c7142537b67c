"""Databases as other tools leave them: formats, encodings, odd attributes, messages of one name; told, and refused only where nothing can be had."""

import cantools
import pytest

from hilrunner.base.errors import DbcError
from hilrunner.setup.database import database_notes, find_message, load_database
from tests.tools import contract

TEXT = contract.DBC.read_text(encoding="utf-8")
KCD = """<?xml version="1.0"?>
<NetworkDefinition xmlns="http://kayak.2codeornot2code.org/1.0"><Document/><Bus name="B"><Message id="0x12" name="SENSORS" length="8">
<Signal name="P1" offset="0" length="16"><Value slope="0.1" unit="bar"/></Signal></Message></Bus></NetworkDefinition>"""


def written(folder, name, text, encoding="utf-8"):
    path = folder / name
    path.write_bytes(text.encode(encoding))
    return path


def test_other_formats_are_read(tmp_path):
    database = load_database(written(tmp_path, "a.kcd", KCD))
    assert database.messages[0].name == "SENSORS" and database.messages[0].signals[0].unit == "bar"
    cantools.database.dump_file(contract.database(), tmp_path / "b.sym")
    names = {message.name for message in load_database(tmp_path / "b.sym").messages}
    assert {"VALVE_COMMAND_1", "PRESSURES_4"} <= names


@pytest.mark.parametrize(
    "change, left",
    [
        (('BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;\n', ""), "GenMsgCycleTime"),
        (('BA_ "GenMsgCycleTime" BO_ 385 1;', 'BA_ "GenMsgCycleTime" BO_ 385 "fast";'), "GenMsgCycleTime"),
    ],
)
def test_an_odd_attribute_costs_itself_alone(tmp_path, change, left):
    path = written(tmp_path, "odd.dbc", TEXT.replace(*change))
    database = load_database(path)
    assert len(database.messages) == 20 and database.messages[0].cycle_time is None
    assert database.messages[0].dbc.attributes["E2EProfile"].value == "P02", "the others are kept"
    (note,) = database_notes(path)
    assert f"'{left}' cannot be read" in note and "in the mapping" in note


def test_two_messages_of_one_name_are_told_and_found_by_identifier(tmp_path):
    path = written(tmp_path, "twice.dbc", TEXT.replace("BO_ 386 PRESSURES_2", "BO_ 386 PRESSURES_1"))
    database = load_database(path)
    (note,) = database_notes(path)
    assert "2 messages are called PRESSURES_1 (0x181, 0x182)" in note and 'message = "0x181"' in note
    with pytest.raises(DbcError, match='2 messages have this name.*message = "0x181"'):
        find_message("x", database, "PRESSURES_1")
    assert find_message("x", database, "0x182").frame_id == 0x182
    with pytest.raises(DbcError, match="no such message"):
        find_message("x", database, "0x999")


def test_what_holds_no_messages_is_refused_in_one_line(tmp_path):
    for name, text in (("a.dbc", "hello"), ("b.kcd", "<x/>"), ("c.arxml", "<x/>"), ("d.sym", "x"), ("e.cdd", "<x/>")):
        with pytest.raises(DbcError) as error:
            load_database(written(tmp_path, name, text))
        assert "\n" not in str(error.value) and name in str(error.value)


def test_a_file_without_oddities_has_no_notes():
    assert database_notes(contract.DBC) == ()

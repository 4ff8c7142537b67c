"""Start values on the wire are those of the database: floats, signed, multiplexed, and the attribute's own default; cantools judges."""

import cantools
import numpy as np

from hilrunner.setup.start_values import start_image, start_value_notes

DBC = """VERSION ""
NS_ :
BS_:
BU_: FIRMWARE BENCH
BO_ 200 SENS: 16 BENCH
 SG_ Page M : 0|4@1+ (1,0) [0|15] "" FIRMWARE
 SG_ Hidden m0 : 8|32@1+ (1,0) [0|0] "" FIRMWARE
 SG_ OilTemp m1 : 8|32@1- (1,0) [-40|150] "degC" FIRMWARE
 SG_ Signed : 47|8@0- (0.5,10) [-40|150] "degC" FIRMWARE
 SG_ Double : 64|64@1- (1,0) [0|0] "" FIRMWARE
 SG_ Unset : 48|4@1+ (1,0) [0|0] "" FIRMWARE
 SG_ Odd : 52|4@1+ (1,0) [0|0] "" FIRMWARE

BA_DEF_ SG_ "GenSigStartValue" FLOAT -1000 4000000000;
BA_DEF_DEF_ "GenSigStartValue" DEFAULT;
BA_ "GenSigStartValue" SG_ 200 Page 1;
BA_ "GenSigStartValue" SG_ 200 Hidden 4294967295;
BA_ "GenSigStartValue" SG_ 200 OilTemp 45.5;
BA_ "GenSigStartValue" SG_ 200 Signed -3;
BA_ "GenSigStartValue" SG_ 200 Double -0.125;
BA_ "GenSigStartValue" SG_ 200 Odd 2.5;
SIG_VALTYPE_ 200 OilTemp : 1;
SIG_VALTYPE_ 200 Double : 2;
"""


def message(default="0"):
    return cantools.database.load_string(DBC.replace("DEFAULT", default), "dbc", strict=False).messages[0]


def test_start_values_are_what_cantools_decodes():
    decoded = message().decode(bytes(start_image(message())[:16]))
    assert decoded["OilTemp"] == 45.5, "a float, chosen by the multiplexer's start value"
    assert decoded["Double"] == -0.125 and decoded["Signed"] == -3 * 0.5 + 10 and decoded["Page"] == 1
    assert "Hidden" not in decoded and decoded["Unset"] == 0


def test_a_chosen_page_carries_its_own_start_values():
    decoded = message().decode(bytes(start_image(message(), {"Page": 0})[:16]))
    assert decoded["Hidden"] == 0xFFFFFFFF and "OilTemp" not in decoded


def test_the_attributes_default_holds_where_a_signal_has_none():
    decoded = message("5").decode(bytes(start_image(message("5"))[:16]))
    assert decoded["Unset"] == 5 and decoded["OilTemp"] == 45.5


def test_start_values_that_do_not_fit_are_told():
    assert len(start_value_notes(message())) == 1 and "SENS.Odd: its start value 2.5" in start_value_notes(message())[0]
    assert message().decode(bytes(start_image(message())[:16]))["Odd"] == 2


def test_image_is_as_wide_as_any_frame():
    assert start_image(message()).shape == (64,) and start_image(message()).dtype == np.uint8

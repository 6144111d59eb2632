"""Reading foreign DBC files: what is read, and each refusal with its line."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from can_dbc import dbc
from can_dbc.dbc import load_dbc, parse_dbc
from can_dbc.errors import InputError

GOOD = """VERSION ""

BU_: A B
BO_ 5 Speeds: 8 A
 SG_ Left : 0|16@1+ (0.5,0) [0|100] "rpm" B
 SG_ Right : 16|16@1+ (0.5,0) [0|100] "rpm" B

BO_ 2566844926 Engine: 8 A
 SG_ Load : 7|8@0+ (1,0) [0|0] "%" B

CM_ SG_ 5 Left "Spinning
BO_ 5 Speeds: 9999 quoted";
BA_DEF_ BO_ "GenMsgCycleTime" INT -10 65535;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_ "GenMsgCycleTime" BO_ 5 20;
VAL_ 5 Left 0 "still" 1 "slow" ;
"""


def refusal(text: str | bytes, strict: bool = True) -> str:
    content = text.encode() if isinstance(text, str) else text
    with pytest.raises(InputError) as caught:
        parse_dbc(content, "x.dbc", strict)
    line = str(caught.value)
    assert "\n" not in line
    assert len(line) < 300
    return line


def changed(old: str, new: str) -> str:
    assert GOOD.count(old) == 1
    return GOOD.replace(old, new)


def test_a_file_is_read_as_cantools_reads_it(tmp_path: Path) -> None:
    path = tmp_path / "good.dbc"
    path.write_text(GOOD)
    database = load_dbc(path)
    speeds = database.get_message_by_name("Speeds")
    assert speeds.cycle_time == 20
    assert speeds.decode(bytes(8)) == {"Left": "still", "Right": 0}
    assert database.get_message_by_name("Engine").frame_id == 0x18FEF1FE


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252"])
def test_encodings(encoding: str) -> None:
    database = parse_dbc(GOOD.replace("Spinning", "Raddrehzahl für °C").encode(encoding))
    comment = database.get_message_by_name("Speeds").get_signal_by_name("Left").comment
    assert comment.startswith("Raddrehzahl für °C")


def test_windows_line_ends() -> None:
    assert len(parse_dbc(GOOD.replace("\n", "\r\n").encode()).messages) == 2


def test_an_empty_database_is_one() -> None:
    assert parse_dbc(b'VERSION ""\n').messages == []


def test_problems_carry_the_name_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "bad.dbc"
    path.write_text(GOOD + "nonsense\n")
    with pytest.raises(InputError, match=rf"^{path}: line 17: column 1: .*nonsense.*not DBC gram"):
        load_dbc(path)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (changed("BO_ 5 Speeds: 8 A", "BO_ 5 Speeds 8 A"), "4: column 14"),
        (changed('1 "slow" ;', '1 "slow'), "16: column 25: "),
        (changed("Speeds: 8 A", "Speeds: 1786 A"), "4: message Speeds has 1786 bytes"),
        (changed("7|8@0+", "7|99999@0+"), "9: signal Load reaches bit 99999; expected"),
        (changed("7|8@0+", "14281|8@0+"), "9: signal Load reaches bit 14281;"),
        (
            changed("BO_ 2566844926 Engine", "BO_ 2566844926 Speeds"),
            "8: message Speeds is declared twice",
        ),
        (
            GOOD + "SG_MUL_VAL_ 5 Left Right 0-1,5-" + 40 * "9" + ";\n",
            "17: multiplexer range 5-99999999999999999999; expected",
        ),
        (
            changed("(1,0) [0|0]", "(1e400,0) [0|0]"),
            "8: signal Load of Engine: inf; expected a finite number",
        ),
        (changed("INT -10 65535", "FLOAT 0 65535").replace("BO_ 5 20", "BO_ 5 1e400"), ""),
        (
            changed("BO_ 5 20", f"BO_ 5 1{400 * '0'}"),
            f"4: message Speeds: cycle time '1{29 * '0'}'; expected 0 to 10^12",
        ),
        (
            changed("(1,0) [0|0]", f"(1,0) [0|1{400 * '0'}]"),
            f"8: signal Load of Engine: 1{29 * '0'}; expected a finite number",
        ),
        (
            changed("INT -10 65535", "STRING").replace("BO_ 5 20", 'BO_ 5 "20"'),
            "4: message Speeds: cycle time '20'; expected 0 to 10^12",
        ),
        (GOOD.replace(" 5 ", " 4096 "), "4: Standard frame id 0x1000 is more than 11 bits"),
        (changed("16|16@1+", "8|16@1+"), "6: The signals Right and Left are overlap"),
        (
            changed("16|16@1+", "60|16@1+"),
            "6: The signal Right does not fit in message Speeds; expected a DBC with",
        ),
        (changed("16|16@1+", "16|0@1+"), "6: The signal Right length 0 is not great"),
    ],
)
def test_refusals(text: str, expected: str) -> None:
    assert refusal(text).startswith(f"x.dbc: line {expected}")


def test_cycle_times_may_have_fractions() -> None:
    text = changed("INT -10 65535", "FLOAT 0 65535").replace("BO_ 5 20", "BO_ 5 2.5")
    assert parse_dbc(text.encode()).get_message_by_name("Speeds").cycle_time == 2.5


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (changed("BO_ 5 20", "BO_ 5 1e999999999999"), 15),
        (changed("BO_ 5 20", 'BO_ 5 "1e999999999999"'), 15),
        (changed("BO_ 5 20", 'BO_ 5 "1e9_99_999_999"'), 15),
        (changed("BO_ 5 20", 'BO_ 5 "1E999999999999"'), 15),
        ('BA_ "GenMsgCycleTime" "1e999999999999";\n', 1),
        (changed('"GenMsgCycleTime" 0', '"GenMsgCycleTime" 1E+999999999999'), 14),
        (changed('"GenMsgCycleTime" 0', '"GenMsgCycleTime" "1.5e999999999999"'), 14),
        (changed("INT -10 65535", "INT -10 1e999999999999"), 13),
        (changed("(1,0) [0|0]", "(1e999999999999,0) [0|0]"), 9),
    ],
)
def test_powers_of_ten_that_nobody_can_write_out(text: str, line: int) -> None:
    assert re.match(rf"x\.dbc: line {line}: number .* has no use$", refusal(text))


def test_numbers_of_very_many_digits_are_refused() -> None:
    assert "x.dbc: " in refusal(changed("[0|0]", f"[0|{200_000 * '9'}]"))


@pytest.mark.parametrize("number", ["2e1", "2e0_1"])
def test_quoted_powers_of_ten_with_a_use_are_numbers(number: str) -> None:
    text = changed("INT -10 65535", "FLOAT 0 65535").replace("BO_ 5 20", f'BO_ 5 "{number}"')
    assert parse_dbc(text.encode()).get_message_by_name("Speeds").cycle_time == 20


def test_texts_that_look_like_powers_of_ten_are_texts() -> None:
    part_number = 'BA_DEF_ "Part" STRING ;\nBA_DEF_DEF_ "Part" "";\nBA_ "Part" "12E3456789";\n'
    text = GOOD.replace("VAL_", part_number + "VAL_").replace('"Spinning', '"9e9999999"; CM_ "')
    assert parse_dbc(text.encode()).dbc.attributes["Part"].value == "12E3456789"


def test_comments_and_escaped_quotes_hide_nothing() -> None:
    """Neither an odd quote in a comment nor an escaped one keeps statements from being seen."""
    huge = changed("Speeds: 8 A", "Speeds: 1786 A")
    for before in ('// "\n', 'CM_ "\\" // ";\n', "// BO_ 1 A: 99999 B\n"):
        line = refusal(huge.replace("BO_ 5 Speeds: 1", before + "BO_ 5 Speeds: 1"))
        assert line.startswith("x.dbc: line 5: message Speeds has 1786 bytes")
    assert "message Speeds has 1786" in refusal(changed("Speeds: 8 A", "Speeds: +1786 A"))
    assert "reaches bit 99999" in refusal(changed("7|8@0+", "+7| +99999 @0+"))


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"VERSION\0", "x.dbc: holds zero bytes; expected the text of a DBC file"),
        (
            GOOD.encode() + b'CM_ "\n\x81 \xff";',
            "x.dbc: line 18: byte 0x81; expected text in UTF-8 or Windows-1252",
        ),
    ],
)
def test_what_is_no_text(content: bytes, expected: str) -> None:
    assert refusal(content) == expected


def test_large_files_are_refused_with_their_line() -> None:
    filler = f'CM_ BU_ A "{"x" * 200_000}";\n'
    line = refusal(changed("VAL_ 5 Left", "VAL_ 6 Left").replace("CM_ SG_", filler + "CM_ SG_"))
    assert line.startswith("x.dbc: line 17: not a DBC that can be understood (ValueError: unused")


MULTIPLEXED = """BU_: A
BO_ 5 Many: 8 A
 SG_ Page m0M : 8|24@1+ (1,0) [0|0] "" A
 SG_ Kind M : 0|8@1+ (1,0) [0|0] "" A
 SG_ Value m0 : 32|8@1+ (1,0) [0|0] "" A

SG_MUL_VAL_ 5 Page Kind 0-1;
SG_MUL_VAL_ 5 Value Page %s;
"""


def test_multiplexer_ranges_up_to_the_limit() -> None:
    database = parse_dbc((MULTIPLEXED % "100000-104095").encode())
    value = database.get_message_by_name("Many").get_signal_by_name("Value")
    assert value.multiplexer_ids == list(range(100_000, 104_096))
    line = refusal(MULTIPLEXED % "100000-104096")
    assert line.startswith("x.dbc: line 8: multiplexer range 100000-104096; expected at most 4096")
    assert "range 0-3000000000" in refusal(MULTIPLEXED % "4000000000-0,0-3000000000")
    for digits in (30, 5000):
        assert f"range {20 * '9'}-0" in refusal(MULTIPLEXED % f"{digits * '9'}-0")
    line = refusal(MULTIPLEXED % "0-2047,3000-5048")
    assert line.startswith("x.dbc: line 8: multiplexer range 3000-5048; expected at most 4096")


def test_without_a_name_it_is_the_dbc() -> None:
    with pytest.raises(InputError, match=r"^DBC: line 1: column 1: "):
        parse_dbc(b"?")


def test_a_first_statement_that_fails_is_named() -> None:
    unused = 'VAL_ 7 Left 0 "still" ;\n'
    assert refusal(unused).startswith("x.dbc: line 1: not a DBC that can")
    assert refusal(unused + GOOD.partition("\n")[2]).startswith("x.dbc: line 1: not a DBC that can")


def test_where_no_statement_is_found_no_line_is_named() -> None:
    inline = refusal('VERSION "" VAL_ 5 Left 0 "still" ;\n')
    assert inline.startswith("x.dbc: not a DBC that can be understood (ValueError: unused VAL_")
    signed = changed("BO_ 5 Speeds: 8", "BO_ +5 Speeds: 8").replace("BO_ 5 Speeds: 9999 ", "")
    line = refusal(signed.replace("BO_ 5 20", "BO_ 5 -5"))
    assert line.startswith("x.dbc: message Speeds: cycle time '-5'")


def test_an_error_that_names_nothing_has_no_line() -> None:
    assert dbc._offset_of(ValueError("something else"), GOOD) is None


def test_cut_reasons_have_their_length() -> None:
    names = [f"S{'x' * 120}{number}" for number in range(2)]
    text = "BO_ 5 M: 8 A\n" + "".join(f' SG_ {n} : 0|8@1+ (1,0) [0|0] "" B\n' for n in names)
    line = refusal(text)
    assert line.startswith("x.dbc: line 3: The signals S") and "...; expected" in line
    assert line.index("; expected") == len("x.dbc: line 3: ") + 160
    assert (
        dbc._reason(KeyError(158 * "x"))
        == f"refers to '{158 * 'x'}', which is not declared; expected its declaration"
    )


WORD_BY_WORD = (
    (
        changed("0|16@1+", "0|16@3+"),
        "5: signal Left has byte order '3'; expected 0 (big-endian) or 1 (little-endian)",
    ),
    (
        changed("7|8@0+", f"7|{30 * '9'}@0+"),
        f"9: signal Load reaches bit {20 * '9'}; expected at most 14280",
    ),
    (
        changed("Speeds: 8 A", f"Speeds: {30 * '9'} A"),
        f"4: message Speeds has {20 * '9'} bytes; expected at most 1785",
    ),
    (
        changed("BO_ 5 20", "BO_ 5 -5"),
        "4: message Speeds: cycle time '-5'; expected 0 to 10^12 milliseconds",
    ),
    (
        GOOD + "SG_MUL_VAL_ 5 Left Right 0-4000000000;\n",
        "17: multiplexer range 0-4000000000; expected at most 4096 values of a signal",
    ),
    (
        MULTIPLEXED % "9223372036854775809-9223372036854775810",
        "8: multiplexer range 9223372036854775809-9223372036854775810; "
        "expected at most 4096 values of a signal",
    ),
    (
        MULTIPLEXED % "9223372036854775809-0",
        "8: multiplexer range 9223372036854775809-0; expected at most 4096 values of a signal",
    ),
    (
        changed('"GenMsgCycleTime" BO_ 5 20', '"Nothing" BO_ 5 20'),
        "15: refers to 'Nothing', which is not declared; expected its declaration",
    ),
    (
        changed("VAL_ 5 Left", "VAL_ 6 Left"),
        "16: not a DBC that can be understood (ValueError: unused VAL_ entries in DBC: VAL_ 6 Left)",
    ),
    (GOOD + "nonsense\n", '17: column 1: ">>!<<nonsense" is not DBC grammar; expected a DBC file'),
    (
        GOOD + "what: is: this\n",
        '17: column 1: ">>!<<what: is: this" is not DBC grammar; expected a DBC file',
    ),
    (changed("(1,0) [0|0]", "(1e401,0) [0|0]"), "9: number 1e401 has no use"),
    (changed("(1,0) [0|0]", f"(1e{60 * '9'},0) [0|0]"), f"9: number 1e{38 * '9'} has no use"),
    (changed("BO_ 5 20", f'BO_ 5 "1e{60 * "9"}"'), f'15: number "1e{37 * "9"} has no use'),
    (changed("BO_ 5 20", 'BO_ 5 "1e4_0_1"'), '15: number "1e4_0_1" has no use'),
    (changed("(1,0) [0|0]", "(0,0) [0|0]"), "8: signal Load of Engine: factor 0"),
    (
        changed("(1,0) [0|0]", "(2e300,0) [0|0]"),
        "8: signal Load of Engine: 200000000000000010500952051040; expected a finite number",
    ),
    (
        changed("BO_ 2566844926 Engine", "BO_ 05 Engine"),
        "8: messages Speeds and Engine share an identifier",
    ),
)


@pytest.mark.parametrize(("text", "reported"), WORD_BY_WORD)
def test_refusals_word_by_word(text: str, reported: str) -> None:
    assert refusal(text) == f"x.dbc: line {reported}"


def test_limits_are_still_allowed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert parse_dbc(changed("(1,0) [0|0]", "(1e300,0) [0|0]").encode()).messages
    assert "expected a finite number" in refusal(changed("(1,0) [0|0]", "(1e400,0) [0|0]"))
    assert parse_dbc(changed("BO_ 5 20", 'BO_ 5 "0e4_0_0"').encode()).messages
    wide = changed("INT -10 65535", "INT 0 99999999999999")
    for shortest in ("0.5", "1"):
        often = changed("INT -10 65535", "FLOAT 0 65535").replace("BO_ 5 20", f"BO_ 5 {shortest}")
        assert parse_dbc(often.encode()).get_message_by_name("Speeds").cycle_time == float(shortest)
    longest = parse_dbc(wide.replace("BO_ 5 20", "BO_ 5 999999999999").encode())
    assert longest.get_message_by_name("Speeds").cycle_time == 10**12 - 1
    assert "cycle time '1000000000000'" in refusal(wide.replace("BO_ 5 20", "BO_ 5 1000000000000"))
    twice = parse_dbc((MULTIPLEXED % "0-4095,9-8").encode())
    value = twice.get_message_by_name("Many").get_signal_by_name("Value")
    assert value.multiplexer_ids == list(range(4096))
    path = tmp_path / "good.dbc"
    path.write_text(GOOD)
    assert load_dbc(path, most_bytes=len(GOOD)).messages
    with pytest.raises(InputError, match=r"good\.dbc: larger than \d+ bytes; expected a DBC file"):
        load_dbc(path, most_bytes=len(GOOD) - 1)


def test_files_are_read_strictly_unless_told_otherwise(tmp_path: Path) -> None:
    path = tmp_path / "overlapping.dbc"
    path.write_text(changed("16|16@1+", "8|16@1+"))
    with pytest.raises(InputError, match="overlapping"):
        load_dbc(path)
    with pytest.raises(InputError, match="overlapping"):
        parse_dbc(path.read_bytes())
    assert load_dbc(path, strict=False).messages

"""Words that error lines share."""

from __future__ import annotations

import errno
import os
import pickle

from can_dbc.errors import InputError, nearest, os_error_text, unknown_name


def test_the_path_and_the_reason_without_python_s_words() -> None:
    full = os.strerror(errno.ENOSPC)
    assert (
        os_error_text(OSError(errno.ENOSPC, full, "out/result.json")) == f"out/result.json: {full}"
    )
    assert os_error_text(OSError(errno.ENOSPC, full)) == full
    assert os_error_text(OSError("no reply")) == "no reply"


def test_a_name_with_line_breaks_stays_on_one_line() -> None:
    error = InputError("s.toml: model: a\nb\x1b[31m\udc80: no such parameter")
    assert str(error) == r"s.toml: model: a\nb\x1b[31m\udc80: no such parameter"
    assert str(InputError(f"x: {error}")) == f"x: {error}"
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_unknown_names_are_answered_with_the_nearest() -> None:
    assert unknown_name("alpa", ["beta", "alpha"]) == "unknown; expected one of alpha, beta"
    many = ["alpha", *map(str, range(10))]
    assert unknown_name("alpa", many) == "unknown; expected one of alpha, ..."
    assert unknown_name("zzz", ["alpha", "beta"]) == "unknown; expected one of alpha, beta"
    assert unknown_name("zzz", []) == "unknown; expected none"
    many = ["aaa1", "aaa2", "aaa3", "aaa4"]
    assert len(nearest("aaa", many, count=4)) == 4
    assert nearest("aa", ["aabbbb"]) == []
    assert nearest("aa", ["aabbbb"], cutoff=0.4) == ["aabbbb"]

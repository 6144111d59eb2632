"""Where local channels are, and who may use them."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from can_dbc.errors import InputError, RunError
from sil.coupling.transports import address

pytestmark = pytest.mark.usefixtures("runtime_folder")


def test_a_name_is_a_socket_in_a_folder_of_this_user_only(runtime_folder: Path) -> None:
    assert address.socket_path("demo") == runtime_folder / "opc4" / "demo.sock"
    assert (runtime_folder / "opc4").stat().st_mode & 0o777 == 0o700
    assert address.socket_path("./here") == Path("here")
    assert address.socket_path(f"{runtime_folder}/b.sock") == runtime_folder / "b.sock"


def test_without_a_runtime_folder_it_is_one_for_temporary_files(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert address.folder() == tmp_path / f"opc4-{os.getuid()}"


@pytest.mark.parametrize("name", ["", ".", "..", "-x", "a b", "a\0b", "ü", "a" * 65, "a\n"])
def test_other_names_are_refused(name: str) -> None:
    with pytest.raises(InputError, match="expected a name of letters"):
        address.socket_path(name)


def test_a_path_too_long_for_a_socket_is_refused() -> None:
    with pytest.raises(InputError, match="expected at most 107 bytes"):
        address.socket_path("/" + "a" * 107)


def test_a_folder_open_to_others_is_refused(runtime_folder: Path) -> None:
    (runtime_folder / "opc4").mkdir()
    (runtime_folder / "opc4").chmod(0o755)
    with pytest.raises(RunError, match="nobody else may enter"):
        address.folder()
    (runtime_folder / "opc4").rmdir()
    (runtime_folder / "opc4").symlink_to(runtime_folder)
    with pytest.raises(RunError, match="nobody else may enter"):
        address.folder()


def test_a_runtime_folder_that_is_missing_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "missing"))
    with pytest.raises(RunError, match="missing/opc4: No such file"):
        address.folder()


def test_running_channels_are_those_that_are_listened_to() -> None:
    assert address.running_channels() == []
    one, _ = address.listen("one")
    two, path = address.listen("two")
    assert address.running_channels() == ["one", "two"]
    two.close()
    assert path.is_socket()
    assert address.running_channels() == ["one"]
    one.close()


def test_a_channel_has_one_hub() -> None:
    first, path = address.listen("demo")
    assert path.stat().st_mode & 0o777 == 0o600
    with pytest.raises(RunError, match="another run uses it"):
        address.listen("demo")
    first.close()
    again, _ = address.listen("demo")
    again.close()


def test_a_hub_too_busy_to_answer_is_still_there() -> None:
    listener, path = address.listen("demo")
    waiting = []
    while True:
        client = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        client.setblocking(False)
        waiting.append(client)
        try:
            client.connect(str(path))
        except BlockingIOError:
            break
    with pytest.raises(RunError, match="another run uses it"):
        address.listen("demo")
    for client in waiting:
        client.close()
    listener.close()


def test_a_file_in_the_way_stays(tmp_path: Path) -> None:
    path = tmp_path / "notes"
    path.write_text("mine")
    with pytest.raises(RunError, match="in use"):
        address.listen(str(path))
    with pytest.raises(InputError, match=r"no folder .*missing; expected an existing one"):
        address.listen(str(tmp_path / "missing" / "x.sock"))
    assert path.read_text() == "mine"

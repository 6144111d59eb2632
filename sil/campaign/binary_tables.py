"""Measurements in binary files: MAT, HDF5, parquet, TDMS and MF4, through their libraries.

Channels of several rates are interpolated to the instants of the fastest one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError
from can_dbc.user_file import regular_file
from sil.files.extras import import_extra

Floats = NDArray[np.float64]


@dataclass
class Channels:
    """Channels of a file as they come: values [n], instants [n] in s and units, if they are stored.

    left_out: those that are no series of numbers.
    """

    values: dict[str, Floats] = field(default_factory=dict)
    times: dict[str, Floats] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)

    def add(self, name: str, values: Any, time_s: Any = None, unit: Any = "") -> None:
        """Add a channel of numbers or dates; others are left out, tables become one channel a column."""
        array = np.asarray(values)
        if array.dtype.kind == "M":
            array = (array - array[:1]) / np.timedelta64(1, "s")
        if array.dtype.kind not in "biuf" or array.size < 1 or array.ndim > 2:
            self.left_out.append(name)
            return
        array = np.squeeze(array).astype(np.float64)
        if array.ndim == 2:
            array = array if array.shape[0] >= array.shape[1] else array.T
            for k in range(array.shape[1]):
                self.add(f"{name}_{k + 1}", array[:, k], time_s, unit)
            return
        if isinstance(unit, bytes):
            unit = unit.decode(errors="replace")
        unit = unit if isinstance(unit, str) else ""
        if name in self.values and unit != self.units.get(name, ""):
            name = f"{name} [{unit or 'no unit'}]"
        same = sum(each == name or each.startswith(f"{name} (") for each in self.values)
        name = f"{name} ({same + 1})" if name in self.values else name
        if unit:
            self.units[name] = unit
        self.values[name] = np.atleast_1d(array)
        if time_s is not None:
            self.times[name] = np.asarray(time_s, dtype=np.float64)

    def table(self, path: Path) -> tuple[dict[str, Floats], str]:
        """Return columns [n] of one length, each in the file's unit, and what was done to the others.

        Raises InputError for a file without channels of numbers.
        """
        if not self.values:
            raise InputError(f"{path}: no channels of numbers; expected at least one")
        longest = max(map(len, self.values.values()))
        fastest = (name for name, values in self.values.items() if len(values) == longest)
        base = next((self.times[name] for name in fastest if name in self.times), None)
        columns = {} if base is None or "time_s" in self.values else {"time_s": base}
        moved, left_out = [], list(self.left_out)
        for name, values in self.values.items():
            if len(values) == longest and (
                name not in self.times or base is None or np.array_equal(self.times[name], base)
            ):
                columns[name] = values
            elif len(values) == 1:
                columns[name] = np.full(longest, values[0])
            elif base is not None and name in self.times:
                columns[name] = np.interp(base, self.times[name], values)
                moved.append(name)
            else:
                left_out.append(name)
        notes = (("interpolated to the fastest channel", moved), ("left out", left_out))
        return columns, ", ".join(f"{what}: {', '.join(names)}" for what, names in notes if names)


def _mat(path: Path) -> Channels:
    from scipy.io import loadmat

    channels = Channels()
    try:
        content = loadmat(path, squeeze_me=True, struct_as_record=False)
    except NotImplementedError:
        return _hdf5(path)
    except (ValueError, OSError, TypeError) as error:
        raise InputError(f"{path}: {error}; expected a MAT file") from None

    def walk(prefix: str, value: Any) -> None:
        if hasattr(value, "_fieldnames"):
            for name in value._fieldnames:
                walk(f"{prefix}.{name}", getattr(value, name))
        else:
            channels.add(prefix, value)

    for name, value in content.items():
        if not name.startswith("__"):
            walk(name, value)
    return channels


def _hdf5(path: Path) -> Channels:
    h5py = import_extra("h5py", "lab", f"{path}: HDF5")
    channels = Channels()
    with h5py.File(path, "r") as file:

        def visit(name: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset):
                unit = item.attrs.get("unit", item.attrs.get("units", ""))
                channels.add(name, item[()], None, unit)

        file.visititems(visit)
    return channels


def _parquet(path: Path) -> Channels:
    parquet = import_extra("pyarrow.parquet", "lab", f"{path}: parquet")
    channels = Channels()
    table = parquet.read_table(path)
    for name in table.column_names:
        channels.add(name, table[name].to_numpy())
    return channels


def _tdms(path: Path) -> Channels:
    nptdms = import_extra("nptdms", "lab", f"{path}: TDMS")
    channels = Channels()
    nptdms.log.log_manager.set_level("ERROR")  # what is wrong is told once
    with path.open("rb") as file:  # which the library leaves open where it fails
        content = nptdms.TdmsFile.read(file)
    for group in content.groups():
        for channel in group.channels():
            timed = "wf_increment" in channel.properties
            time_s = channel.time_track() if timed else None
            unit = channel.properties.get("unit_string", "")
            channels.add(channel.name, channel[:], time_s, unit)
    return channels


def _mf4(path: Path) -> Channels:
    asammdf = import_extra("asammdf", "mdf", f"{path}: MF4")
    channels = Channels()
    with asammdf.MDF(path) as file:
        for signal in file.iter_channels():
            channels.add(signal.name, signal.samples, signal.timestamps, signal.unit)
    return channels


BINARY: dict[str, Callable[[Path], Channels]] = {
    ".mat": _mat,
    ".h5": _hdf5,
    ".hdf5": _hdf5,
    ".parquet": _parquet,
    ".tdms": _tdms,
    ".mf4": _mf4,
}
"""Readers by suffix."""


def read_binary(path: Path) -> tuple[dict[str, Floats], str, dict[str, str]]:
    """Return the columns [n] of a binary file, what it is in words, and its units by column.

    Raises InputError for a missing extra, a file that is not what its suffix says, no channels.
    """
    name = path.suffix[1:].upper()
    with regular_file(path, f"a {name} file"):
        pass  # the library opens it by its name
    try:
        channels = BINARY[path.suffix.lower()](path)
        columns, note = channels.table(path)
    except InputError:
        raise
    except Exception as error:  # each library has errors of its own
        text = str(error).partition("\n")[0]
        raise InputError(f"{path}: {text}; expected a whole {name} file") from None
    return columns, ", ".join(filter(None, (name, note))), channels.units

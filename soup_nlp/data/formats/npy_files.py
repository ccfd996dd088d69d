"""Reading of .npy and .npz files, which checks headers before it allocates memory."""

from __future__ import annotations

import io
import math
import zipfile
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from soup_nlp.data.formats.images import check_body
from soup_nlp.errors import DataError
from soup_nlp.schema.limits import MAX_PIXELS
from soup_nlp.storage.files import PathLike, read_bytes


def read_npy(path: PathLike, what: str) -> NDArray[Any]:
    """One array of real numbers from a .npy file, without pickles.

    Raises:
        DataError: the file is missing, malformed, or differs from its header.
    """
    return _array(read_bytes(path, what), path, what)


def _array(content: bytes, path: PathLike, what: str) -> NDArray[Any]:
    stream = io.BytesIO(content)
    try:
        # from version 2 on the length of the header has four bytes; version 3 uses UTF-8
        if npy.read_magic(stream)[0] == 1:
            shape, fortran, kind = npy.read_array_header_1_0(stream)
        else:
            shape, fortran, kind = npy.read_array_header_2_0(stream)
    except Exception as error:  # parsing the header, a Python literal, raises many types
        raise DataError(
            f"{what} is not a readable .npy file", where=path, found=str(error)
        ) from error
    if kind.kind not in "fiu":
        raise DataError(
            f"{what} does not hold numbers",
            where=path,
            found=kind,
            expected="one array of real numbers",
        )
    if any(side < 0 for side in shape):
        raise DataError(f"{what} is not a readable .npy file", where=path, found=f"shape {shape}")
    check_body(len(content) - stream.tell(), math.prod(shape) * kind.itemsize, path, what)
    flat = np.frombuffer(content, kind, offset=stream.tell())
    try:
        return flat.reshape(shape, order="F" if fortran else "C")
    except ValueError as error:
        # more axes than an array can have
        raise DataError(f"{what} has no possible shape", where=path, found=error) from None


def read_npz(path: PathLike, what: str) -> dict[str, NDArray[Any]]:
    """The arrays of a .npz file by name, see `read_npy`.

    Raises:
        DataError: the file is missing, is no .npz, or is too large when unpacked.
    """
    content, most = read_bytes(path, what), 32 * MAX_PIXELS
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            # a small file may be large when unpacked
            size = sum(entry.file_size for entry in archive.infolist())
            if size > most:
                raise DataError(
                    f"{what} is too large", where=path, found=f"{size} bytes", expected=most
                )
            parts = {name: archive.read(name) for name in archive.namelist()}
    except (zipfile.BadZipFile, OSError, RuntimeError, NotImplementedError, ValueError) as error:
        raise DataError(f"{what} is no .npz", where=path, found=str(error)) from error
    return {
        name.removesuffix(".npy"): _array(part, path, f"{what}, {name}")
        for name, part in parts.items()
    }

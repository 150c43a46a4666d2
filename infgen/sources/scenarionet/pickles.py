"""Read the pickles of ScenarioNet and MetaDrive without running anything in them.

The project uses no pickle, for one runs code when it is loaded. ScenarioNet knows no other
format, so this module, and no other, reads the subset of it that plain data needs:

- Only opcodes in ``_OPCODES`` are known: strings, bytes, numbers, None, booleans, lists,
  tuples, dictionaries and sets. Keys and members must be plain, so that nothing is hashed
  that can be nested without end.
- The only names that a file may import are those in ``_NAMES``: what numpy's arrays, and
  sets of older protocols, are made of. They stand for inert stand-ins of this module: no
  function or class of numpy sees anything of a file before ``array`` has checked its type,
  shape and size.

The standard library's unpickler in Python (``pickle._Unpickler``) is the base, not the one
in C: a few bytes make that one allocate gigabytes (its memo is an array as long as the
highest index) or overflow the stack.
"""

import io
import math
import pickle
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from infgen.sources.tfrecord import RecordError

MAX_ITEMS = 1 << 25
"""Values of one array."""
_DTYPE = re.compile(r"[<>=|]?(b1|[iu][1248]|f[248]|U\d{1,4}|S\d{1,4}|O8?)")
_FAULTS = (
    pickle.UnpicklingError,
    EOFError,
    KeyError,
    IndexError,
    TypeError,
    ValueError,
    AttributeError,
    OverflowError,
    struct.error,
)
"""What the standard library raises on bytes that are no pickle."""


class _Inert:
    """Something that a pickle names; it can be neither changed nor built upon."""

    __slots__ = ()

    def __setstate__(self, state: Any) -> None:
        raise pickle.UnpicklingError("the file changes a name that it imports")


@dataclass(frozen=True, slots=True)
class _Function(_Inert):
    """A function that a pickle may call."""

    call: Callable[..., Any]


class DType:
    """A type of array elements, by name, until it is used."""

    __slots__ = ("byte_order", "name")

    def __init__(self, name: Any, *_: Any) -> None:
        if not isinstance(name, str) or not _DTYPE.fullmatch(name):
            raise pickle.UnpicklingError(f"arrays of type {str(name)[:40]!r}")
        self.name, self.byte_order = name, ""

    def set_state(self, state: Any) -> None:
        """Take the byte order; the rest is of types that are not allowed."""
        order = state[1]
        if order not in ("<", ">", "=", "|"):
            raise pickle.UnpicklingError(f"byte order {str(order)[:40]!r}")
        self.byte_order = order

    def numpy(self) -> np.dtype[Any]:
        """Return numpy's type."""
        return np.dtype(self.byte_order + self.name.lstrip("<>=|"))


class Array:
    """An array of a file, as bytes or a list, until ``array`` has checked it."""

    __slots__ = ("_fortran", "_raw", "_shape", "_type")

    def __init__(self) -> None:
        self._shape: Any = None

    def set_state(self, state: Any) -> None:
        """Take shape, type, order and elements, as numpy writes them."""
        _, self._shape, self._type, self._fortran, self._raw = state

    def read(self) -> np.ndarray:
        """Return the array.

        Raises:
            RecordError: if its type, shape and bytes do not go together.
        """
        shape = self._shape
        if not isinstance(shape, tuple) or not isinstance(self._type, DType):
            raise RecordError("an array has no shape or no type")
        if not all(type(size) is int and 0 <= size <= MAX_ITEMS for size in shape):
            raise RecordError(f"an array has shape {str(shape)[:80]}")
        count, dtype = math.prod(shape), self._type.numpy()
        if len(shape) > 4 or count > MAX_ITEMS:
            raise RecordError(f"an array has shape {str(shape)[:80]}")
        if dtype.kind == "O":
            return self._objects(count, shape)
        if not isinstance(self._raw, bytes | bytearray):
            raise RecordError("an array has no bytes")
        if count * dtype.itemsize != len(self._raw):
            raise RecordError(f"an array of shape {shape} holds {len(self._raw)} bytes")
        if not count:
            return np.empty(shape, dtype)
        return np.frombuffer(bytes(self._raw), dtype).reshape(
            shape, order="F" if self._fortran else "C"
        )

    def _objects(self, count: int, shape: tuple[int, ...]) -> np.ndarray:
        if not isinstance(self._raw, list) or len(self._raw) != count or len(shape) != 1:
            raise RecordError(f"an array of shape {shape} is no plain list")
        found = np.empty(count, object)
        found[:] = self._raw
        return found


def _reconstruct(kind: Any, shape: Any, code: Any) -> Array:
    return Array()


def _from_buffer(raw: Any, dtype: Any, shape: Any, order: Any) -> Array:
    found = Array()
    found.set_state((1, shape, dtype, order == "F", raw))
    return found


def _scalar(dtype: Any, raw: Any = None) -> Any:
    found = _from_buffer(raw, dtype, (1,), "C").read()[0]
    return found.item() if isinstance(found, np.generic) else found


def _encode(text: str, encoding: str = "latin1") -> bytes:
    """Take bytes as protocol 2 writes them."""
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"bytes encoded as {encoding!r}")
    return text.encode("latin1")


def _no_bytes() -> bytes:
    """Take the empty bytes of protocol 2."""
    return b""


def _set(items: Any = ()) -> set[Any]:
    """Take a set as protocols 2 and 3 write it."""
    if not isinstance(items, list | tuple) or not _are_plain(items):
        raise pickle.UnpicklingError("it fills a set with what is not plain")
    return set(items)


_NAMES: dict[tuple[str, str], _Inert] = {
    ("numpy", "ndarray"): _Inert(),
    ("numpy", "dtype"): _Function(DType),
    ("_codecs", "encode"): _Function(_encode),
    ("__builtin__", "bytes"): _Function(_no_bytes),
    ("__builtin__", "set"): _Function(_set),
    ("builtins", "set"): _Function(_set),
    **{
        (f"numpy.{core}.{module}", name): _Function(function)
        for core in ("core", "_core")
        for module, name, function in (
            ("multiarray", "_reconstruct", _reconstruct),
            ("multiarray", "scalar", _scalar),
            ("numeric", "_frombuffer", _from_buffer),
        )
    },
}
"""All that a file may import, and what stands for it."""

_OPCODES = b"".join(
    [
        *(pickle.PROTO, pickle.FRAME, pickle.STOP, pickle.MARK, pickle.POP),
        *(pickle.NONE, pickle.NEWTRUE, pickle.NEWFALSE, pickle.BINFLOAT),
        *(pickle.BININT, pickle.BININT1, pickle.BININT2, pickle.LONG1, pickle.LONG4),
        *(pickle.SHORT_BINUNICODE, pickle.BINUNICODE, pickle.BINUNICODE8),
        *(pickle.SHORT_BINBYTES, pickle.BINBYTES, pickle.BINBYTES8, pickle.BYTEARRAY8),
        *(pickle.EMPTY_LIST, pickle.EMPTY_TUPLE, pickle.EMPTY_DICT, pickle.EMPTY_SET),
        *(pickle.TUPLE, pickle.TUPLE1, pickle.TUPLE2, pickle.TUPLE3),
        *(pickle.APPEND, pickle.APPENDS, pickle.SETITEM, pickle.SETITEMS, pickle.ADDITEMS),
        *(pickle.MEMOIZE, pickle.BINPUT, pickle.LONG_BINPUT),
        *(pickle.BINGET, pickle.LONG_BINGET),
        *(pickle.GLOBAL, pickle.STACK_GLOBAL, pickle.REDUCE, pickle.BUILD),
    ]
)


class _Unpickler(pickle._Unpickler):
    """The standard library's unpickler in Python, with less than it can."""

    if TYPE_CHECKING:  # What the base class has, and its stubs do not tell of.
        stack: list[Any]
        append: Callable[[Any], None]
        pop_mark: Callable[[], list[Any]]
        read: Callable[[int], bytes]

    def find_class(self, module: str, name: str) -> Any:
        """Return what stands for an imported name, and import nothing."""
        try:
            return _NAMES[module, name]
        except KeyError:
            raise pickle.UnpicklingError(
                f"it imports {module[:40]}.{name[:40]}, which is neither a plain container "
                "nor an array"
            ) from None

    def load_reduce(self) -> None:
        """Call one of our functions, and no other."""
        arguments, function = self.stack.pop(), self.stack[-1]
        if not isinstance(function, _Function) or not isinstance(arguments, tuple):
            raise pickle.UnpicklingError("it calls what is no function")
        self.stack[-1] = function.call(*arguments)

    def load_build(self) -> None:
        """Fill an array or a type of elements, and nothing else."""
        state, target = self.stack.pop(), self.stack[-1]
        if not isinstance(target, Array | DType) or not isinstance(state, tuple):
            raise pickle.UnpicklingError("it changes what is no array")
        target.set_state(state)

    def load_setitem(self) -> None:
        """Put one item into a dictionary."""
        value, key = self.stack.pop(), self.stack.pop()
        self._put([key], [value])

    def load_setitems(self) -> None:
        """Put items into a dictionary."""
        items = self.pop_mark()
        self._put(items[::2], items[1::2])

    def load_additems(self) -> None:
        """Put members into a set."""
        items, target = self.pop_mark(), self.stack[-1]
        if type(target) is not set or not _are_plain(items):
            raise pickle.UnpicklingError("it fills what is no set of plain values")
        target.update(items)

    def load_append(self) -> None:
        """Append one item to a list."""
        self._extend([self.stack.pop()])

    def load_appends(self) -> None:
        """Append items to a list."""
        self._extend(self.pop_mark())

    def load_bytearray8(self) -> None:
        """Take bytes without first making room for as many as the file says."""
        (size,) = struct.unpack("<Q", self.read(8))
        if size > MAX_ITEMS * 8:
            raise pickle.UnpicklingError(f"bytes of length {size}")
        self.append(self.read(size))

    def _put(self, keys: list[Any], values: list[Any]) -> None:
        target = self.stack[-1]
        if type(target) is not dict or not _are_plain(keys):
            raise pickle.UnpicklingError("it fills what is no dictionary of plain keys")
        target.update(zip(keys, values, strict=True))

    def _extend(self, items: list[Any]) -> None:
        target = self.stack[-1]
        if type(target) is not list:
            raise pickle.UnpicklingError("it appends to what is no list")
        target.extend(items)

    dispatch: ClassVar[dict[int, Any]] = {
        **{code: pickle._Unpickler.dispatch[code] for code in _OPCODES},
        pickle.REDUCE[0]: load_reduce,
        pickle.BUILD[0]: load_build,
        pickle.SETITEM[0]: load_setitem,
        pickle.SETITEMS[0]: load_setitems,
        pickle.ADDITEMS[0]: load_additems,
        pickle.APPEND[0]: load_append,
        pickle.APPENDS[0]: load_appends,
        pickle.BYTEARRAY8[0]: load_bytearray8,
    }


_PLAIN = frozenset((str, int, float, bool, type(None)))


def _are_plain(values: Any) -> bool:
    return all(type(value) in _PLAIN for value in values)


def unpickle(data: bytes) -> Any:
    """Read plain containers, and arrays as ``Array``, from a pickle.

    Raises:
        RecordError: if it holds anything else, or is damaged.
    """
    if data[:1] != pickle.PROTO:
        raise RecordError("not a pickle of protocol 2 or newer")
    try:
        return _Unpickler(io.BytesIO(data)).load()
    except _FAULTS as error:
        said = str(error) if isinstance(error, pickle.UnpicklingError) else "damaged"
        raise RecordError(f"not a usable pickle: {said or 'damaged'}") from error


def pickled(value: Any) -> bytes:
    """Write plain containers and numpy arrays as the pickle that ScenarioNet reads."""
    return pickle.dumps(value, protocol=4)


def array(value: Any, dtype: Any = np.float64) -> np.ndarray:
    """Return an array of a file, or a list of numbers or of rows, as an array of one type.

    Raises:
        RecordError: if it is neither, or its elements are no numbers.
    """
    if isinstance(value, Array):
        found = value.read()
        if found.dtype.kind not in "biuf":
            raise RecordError(f"an array holds elements of type {found.dtype}")
        return _cast(found, dtype)
    if not isinstance(value, list | tuple):
        raise RecordError(f"expected an array, got {type(value).__name__}")
    if not value or not isinstance(value[0], list | tuple | Array):
        return _cast(_numbers(value), dtype)
    rows = [array(row, dtype) if isinstance(row, Array) else _numbers(row) for row in value]
    if any(np.shape(row) != np.shape(rows[0]) or np.ndim(row) > 2 for row in rows):
        raise RecordError("an array has rows of different lengths")
    return _cast(rows, dtype)


def _numbers(row: Any) -> list[Any] | tuple[Any, ...]:
    """Return a row if it is a list of numbers: nothing nested reaches numpy."""
    if not isinstance(row, list | tuple):
        raise RecordError(f"expected numbers, got {type(row).__name__}")
    if not all(type(each) in (float, int, bool) for each in row):
        raise RecordError("an array holds something else than numbers")
    return row


def _cast(found: Any, dtype: Any) -> np.ndarray:
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(found, dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise RecordError(f"not an array of numbers: {error}") from error

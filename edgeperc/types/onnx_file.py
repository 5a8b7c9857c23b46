"""Read one metadata entry of an .onnx file, and check its graph, without onnx or onnxruntime.

An .onnx file is a protobuf message, a sequence of fields. Each field begins with its number and type, and may be a
message itself. Two readers that disagree about a file are a risk, so everything unusual is refused: groups, numbers
that do not fit, and fields that extend beyond their message.
"""

from __future__ import annotations

import io
import math
import os
import stat
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

from ..errors import CardError, ModelFileError
from ..system.fields import Fields

_FIELDS = Fields("the model", ModelFileError)
MAX_BYTES = 2 * 10**9  # protobuf itself stops at 2 GiB
MAX_ENTRY_BYTES = 16 * 10**6
MAX_TOP_FIELDS = 10_000  # of the file itself, which has about twenty; a file of empty fields would take minutes to read
MAX_FIELDS = 1_000_000  # of a whole file; the shipped ones have a few thousand at most
MAX_DEPTH = 32  # messages within messages; a graph without subgraphs needs 5
TRUST = "pass trusted=True, or --trusted to edgeperc run, if you know where it comes from"
MAX_NODES = 20_000
MAX_WEIGHT_BYTES = 10**9
MAX_FOLDED = 2**28  # values that onnxruntime computes from constants while it opens a file
N_TYPES = 28  # of TensorProto.DataType in ONNX 1.23, from 1 on; onnxruntime 1.23.2 looks others up past its table
MAX_SMALL = 2**16  # values of one arithmetic result of constants: shapes and scales, not weights

_OPERATORS = """
Abs Add And ArgMax AveragePool BatchNormalization Cast Ceil Clip Concat Constant ConstantOfShape Conv ConvInteger
ConvTranspose DepthToSpace DequantizeLinear Div Dropout DynamicQuantizeLinear Elu Equal Erf Exp Expand Flatten Floor
Gather GatherElements GatherND Gelu Gemm GlobalAveragePool GlobalMaxPool Greater GreaterOrEqual GroupNormalization
HardSigmoid HardSwish Identity InstanceNormalization LRN LayerNormalization LeakyRelu Less LessOrEqual Log LogSoftmax
MatMul MatMulInteger Max MaxPool Mean Min Mish Mul Neg NonZero Not Or PRelu Pad Pow QLinearConv QLinearMatMul
QuantizeLinear Range Reciprocal ReduceMax ReduceMean ReduceMin ReduceSum Relu Reshape Resize ScatterElements ScatterND
Selu Shape Sigmoid Slice Softmax Softplus Softsign SpaceToDepth Split Sqrt Squeeze Sub Sum Tanh Tile TopK Transpose
Unsqueeze Where
"""
OPERATORS = frozenset(_OPERATORS.split())
"""Operators of ONNX that a model may consist of: what edgeperc exports, and what else is common in convolutional
networks. None runs another graph, and none repeats."""

# Results of constants alone are computed while a file is opened, where nothing can stop it. These operators give at
# most as many values as they take, ...
_STEADY = "Cast DequantizeLinear Flatten Identity QuantizeLinear Reshape Slice Squeeze Transpose Unsqueeze"
STEADY = frozenset(_STEADY.split())
# ... these a product of them; of the others the size depends on values, or each value takes long.
_SMALL = """
Abs Add And Ceil Clip Concat Div Equal Exp Floor Gather Greater GreaterOrEqual Less LessOrEqual Log Max Min Mul Neg
Not Or Pow Reciprocal ReduceMax ReduceMean ReduceMin ReduceSum Sqrt Sub Sum Where
"""
SMALL = frozenset(_SMALL.split())
# onnxruntime takes the shape of a kernel from the weights if the node does not give it, and reads past the end of its
# memory where the input has fewer axes: 1.23.2, the newest for Python 3.10, notices, and ends the process.
WITH_KERNELS = frozenset({"Conv", "ConvInteger", "ConvTranspose", "QLinearConv"})
# The size of these depends on values. A graph with one that takes few constants is opened without computing with
# constants: a scatter of pillars has them.
DEFERRED = frozenset(
    {"ConstantOfShape", "Expand", "GatherND", "NonZero", "Range", "ScatterElements", "ScatterND", "Tile"}
)


def open_model(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a model's file, which has to be a regular file of at most 2 GB."""
    path = _FIELDS.path("the model", path)
    try:
        # A pipe would be waited for if it were not opened without blocking.
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
        file = os.fdopen(os.open(path, flags), "rb")
    except (OSError, ValueError) as exc:  # ValueError: a null byte in the path
        raise ModelFileError(f"{os.fspath(path)} cannot be read: {getattr(exc, 'strerror', None) or exc}") from exc
    status = os.fstat(file.fileno())
    if stat.S_ISREG(status.st_mode) and status.st_size <= MAX_BYTES:
        return file
    file.close()
    if stat.S_ISREG(status.st_mode):
        raise ModelFileError(f"{os.fspath(path)} has {status.st_size} bytes; expected at most {MAX_BYTES}")
    raise ModelFileError(f"{os.fspath(path)} cannot be read: it is not a regular file; give the path of an .onnx file")


def read_model(path: str | os.PathLike[str]) -> bytes:
    """The bytes of a model's file."""
    with open_model(path) as file:
        try:
            # A read of a size allocates it, however small the file is; one that grows meanwhile is no model.
            return file.read(min(MAX_BYTES, os.fstat(file.fileno()).st_size))
        except OSError as exc:
            raise ModelFileError(f"{os.fspath(path)} cannot be read: {exc.strerror or exc}") from exc


def read_metadata(path: str | os.PathLike[str], key: str) -> str | None:
    """Read the text of a metadata entry: the last one if the key occurs several times, as in onnxruntime, or None."""
    wanted, value = key.encode(), None
    with open_model(path) as file:
        reader = _Reader(file, MAX_TOP_FIELDS)
        try:
            for number, _, start, end in reader.fields(0, os.fstat(file.fileno()).st_size):
                if number == 14:  # metadata_props
                    entry = _entry(reader, start, end, wanted)
                    value = value if entry is None else entry
        except OSError as exc:
            raise ModelFileError(f"{os.fspath(path)} cannot be read: {exc.strerror or exc}") from exc
        except ValueError as exc:
            raise _damaged(path, exc) from exc
        if value is None:
            return None
        if value[1] - value[0] > MAX_ENTRY_BYTES:
            raise CardError(
                f"{os.fspath(path)}: the entry {key} has {value[1] - value[0]} bytes; expected at most "
                f"{MAX_ENTRY_BYTES}; export the model again"
            )
        try:
            return reader.content(*value).decode("utf-8")
        except ValueError as exc:
            raise CardError(f"{os.fspath(path)}: the entry {key} is not UTF-8 ({exc}); export the model again") from exc


def _damaged(path: str | os.PathLike[str], exc: ValueError) -> ModelFileError:
    return ModelFileError(f"{os.fspath(path)} is not a complete .onnx file ({exc}); copy or export the model again")


def _entry(reader: _Reader, start: int, end: int, wanted: bytes) -> tuple[int, int] | None:
    """Start and end of the value of a metadata entry; None if the entry has another key."""
    key, value = b"", (0, 0)
    for number, _, first, last in reader.fields(start, end):
        if number == 1:
            key = reader.content(first, last) if last - first == len(wanted) else b""
        elif number == 2:
            value = first, last
    return value if key == wanted else None


class _Reader:
    """Walks protobuf messages in a file."""

    def __init__(self, file: BinaryIO, max_fields: int) -> None:
        self._file = file
        self._left = max_fields

    def content(self, start: int, end: int) -> bytes:
        self._file.seek(start)
        return self._file.read(end - start)

    def fields(self, start: int, end: int) -> Iterator[tuple[int, int | None, int, int]]:
        """Yield the fields of the message from ``start`` to ``end``: number, value, start and end of the content.

        The value is that of an integer, and None for bytes. Fields of four and eight bytes are left out.
        """
        file = self._file
        file.seek(start)
        while start < end:
            tag = self._varint(end)
            number, wire_type = tag >> 3, tag & 7
            self._left -= 1
            if self._left < 0:
                raise ValueError("it has too many fields")
            if wire_type not in (0, 1, 2, 5) or number == 0 or tag >= 2**32:
                raise ValueError(f"no field begins at byte {start}")
            if wire_type == 0:
                value = self._varint(end)
                start = file.tell()
                yield number, value, start, start
            else:
                length = self._varint(end) if wire_type == 2 else 8 if wire_type == 1 else 4
                first = file.tell()
                start = first + length
                if start > end:
                    raise ValueError(f"it ends within the field at byte {first}")
                if wire_type == 2:
                    yield number, None, first, start
            file.seek(start)

    def integers(self, value: int | None, start: int, end: int) -> Iterator[int]:
        """Yield the values of a repeated field of integers, stored one by one or packed."""
        if value is not None:
            yield value
            return
        self._file.seek(start)
        while self._file.tell() < end:
            yield self._varint(end)

    def _varint(self, end: int) -> int:
        file, value = self._file, 0
        for shift in range(0, 70, 7):
            byte = file.read(1)
            if not byte or file.tell() > end:
                raise ValueError("it ends within a number")
            value |= (byte[0] & 0x7F) << shift
            if byte[0] < 0x80:
                return value
        raise ValueError(f"the number at byte {file.tell()} has more than ten bytes")


def check_graph(blob: bytes, path: str | os.PathLike[str], *, trusted: bool = False) -> bool:
    """Refuse a graph that could read other files, run without end or take all memory while it is opened; if
    ``trusted``, only one that is damaged or reads other files.

    Returns whether what depends on constants alone may be computed while the file is opened; else it has to wait for
        the first run, which can be stopped.
    """
    if blob[4:8] == b"ORTM":  # onnxruntime would read it in its own format, which is not checked here
        raise ModelFileError(f"{os.fspath(path)} is in onnxruntime's own format; expected an .onnx file")
    try:
        check = _GraphCheck(blob, os.fspath(path), trusted)
        check.model()
        return not check.is_deferred
    except ValueError as exc:
        raise _damaged(path, exc) from exc


class _Node(NamedTuple):
    operator: str
    inputs: frozenset[bytes]
    outputs: frozenset[bytes]
    n_values: int
    """Of its attributes, at most."""


class _GraphCheck:
    """Walks a ModelProto. Numbers of fields are those of onnx.proto."""

    def __init__(self, blob: bytes, path: str, trusted: bool) -> None:
        self._reader = _Reader(io.BytesIO(blob), MAX_FIELDS)
        self._size, self._path, self._trusted = len(blob), path, trusted
        self._n_weight_bytes = self._n_folded = 0
        self.is_deferred = False
        self._constants: dict[bytes, int] = {}  # name to number of values
        self._nodes: list[_Node] = []

    def model(self) -> None:
        graphs = []
        for number, value, start, end in self._reader.fields(0, self._size):
            if value is not None:
                continue
            if number == 7:
                graphs.append((start, end))
            elif number == 20:  # training_info
                self._refuse_unless_trusted("holds graphs for training")
                for _, _, first, last in self._messages(start, end, 1, 2):
                    self._graph(first, last, 1)
            elif number == 25:  # functions
                self._refuse_unless_trusted("defines functions of its own")
                for part, _, first, last in self._messages(start, end, 7, 11):
                    (self._node if part == 7 else self._attribute)(first, last, 1)
        for graph in graphs:  # a parser joins them into one; initializers may stand behind the nodes
            self._initializers(*graph, 1)
        for graph in graphs:
            self._walk_nodes(*graph, 1)
        if not self._trusted:
            self._follow_constants()

    def _messages(self, start: int, end: int, *numbers: int) -> Iterator[tuple[int, None, int, int]]:
        for number, value, first, last in self._reader.fields(start, end):
            if value is None and number in numbers:
                yield number, None, first, last

    def _refuse_unless_trusted(self, what: str) -> None:
        if not self._trusted:
            raise ModelFileError(f"{self._path} {what}; {TRUST}")

    def _graph(self, start: int, end: int, depth: int) -> None:
        self._initializers(start, end, depth)
        self._walk_nodes(start, end, depth)

    def _initializers(self, start: int, end: int, depth: int) -> None:
        if depth > MAX_DEPTH:
            raise ModelFileError(f"{self._path} holds graphs in graphs more than {MAX_DEPTH} deep")
        for number, _, first, last in self._messages(start, end, 5, 15):
            if number == 5:
                name, n_values = self._tensor(first, last)
                self._constants[name] = n_values
            else:
                self._sparse_tensor(first, last)

    def _walk_nodes(self, start: int, end: int, depth: int) -> None:
        for _, _, first, last in self._messages(start, end, 1):
            self._node(first, last, depth)

    def _node(self, start: int, end: int, depth: int) -> None:
        operator = domain = b""
        inputs: list[bytes] = []
        outputs: list[bytes] = []
        attributes: set[bytes] = set()
        n_values = 0
        for number, _, first, last in self._messages(start, end, 1, 2, 4, 5, 7):
            if number == 5:
                attribute, n_inside = self._attribute(first, last, depth)
                attributes.add(attribute)
                n_values += n_inside
                continue
            text = self._reader.content(first, last)
            if number == 1:
                inputs.append(text)
            elif number == 2:
                outputs.append(text)
            elif number == 4:
                operator = text
            else:
                domain = text
        if self._trusted:
            return
        name = operator.decode("ascii", "backslashreplace")[:100]
        if domain not in (b"", b"ai.onnx"):
            name = f"{domain.decode('ascii', 'backslashreplace')[:100]}.{name}"
        if name not in OPERATORS:
            self._refuse_unless_trusted(f"has a node {name!r}, which is not among the operators that are opened")
        if name in WITH_KERNELS and b"kernel_shape" not in attributes:
            self._refuse_unless_trusted(f"has a {name!r} without its kernel_shape, which every exporter writes")
        if len(self._nodes) >= MAX_NODES:
            self._refuse_unless_trusted(f"has more than {MAX_NODES} nodes")
        self._nodes.append(_Node(name, frozenset(inputs) - {b""}, frozenset(outputs), n_values))

    def _follow_constants(self) -> None:
        """Count what onnxruntime computes from constants alone while it opens the file."""
        # From the constants on, for nodes may come in any order. A shape is known without its tensor.
        needed = [set() if each.operator == "Shape" else each.inputs - self._constants.keys() for each in self._nodes]
        users: dict[bytes, list[int]] = {}
        for index, names in enumerate(needed):
            for name in names:
                users.setdefault(name, []).append(index)
        ready = [index for index, names in enumerate(needed) if not names]
        n_needed = [len(names) for names in needed]
        while ready:
            node = self._nodes[ready.pop()]
            if node.operator in DEFERRED and sum(self._constants[name] for name in node.inputs) <= MAX_SMALL:
                self.is_deferred = True  # what it gives is computed in a run: no constant
                continue
            n_values = self._n_computed(node)
            self._n_folded += n_values
            if self._n_folded > MAX_FOLDED:
                self._refuse_unless_trusted(f"computes more than {MAX_FOLDED} values from constants alone")
            for name in node.outputs - self._constants.keys():
                self._constants[name] = n_values
                for index in users.get(name, ()):
                    n_needed[index] -= 1
                    if n_needed[index] == 0:
                        ready.append(index)

    def _n_computed(self, node: _Node) -> int:
        """Values of a node whose inputs are all constants, at most."""
        if node.operator in ("Constant", "Shape"):
            return max(node.n_values, 8)
        sizes = [max(self._constants[name], 1) for name in node.inputs]
        if node.operator in STEADY:
            return max(sizes, default=1)
        n_values = sum(sizes) if node.operator == "Concat" else math.prod(sizes)
        if node.operator not in SMALL or n_values > MAX_SMALL:
            self._refuse_unless_trusted(f"has a {node.operator!r} that computes with constants alone")
        return n_values

    def _attribute(self, start: int, end: int, depth: int) -> tuple[bytes, int]:
        """Name, and number of values, at most."""
        name, n_values = b"", end - start
        for number, _, first, last in self._messages(start, end, 1, 5, 6, 10, 11, 22, 23):
            if number == 1:
                name = self._reader.content(first, last)
            elif number in (5, 10):
                n_values += self._tensor(first, last)[1]
            elif number in (22, 23):
                self._sparse_tensor(first, last)
            else:
                self._refuse_unless_trusted("has a node that holds a graph")
                self._graph(first, last, depth + 1)
        return name, n_values

    def _sparse_tensor(self, start: int, end: int) -> None:
        self._refuse_unless_trusted("holds a sparse tensor")
        for _, _, first, last in self._messages(start, end, 1, 2):
            self._tensor(first, last)

    def _tensor(self, start: int, end: int) -> tuple[bytes, int]:
        """Name, and number of values."""
        name, n_bytes = b"", end - start
        shape: list[int] = []
        for number, value, first, last in self._reader.fields(start, end):
            if number == 13 or (number == 14 and value != 0):  # external_data, data_location
                raise ModelFileError(f"{self._path} keeps weights in other files; export it with its weights inside")
            if number == 8 and value is None:
                name = self._reader.content(first, last)
            elif number == 2 and value is not None and not 1 <= value <= N_TYPES:
                raise ModelFileError(f"{self._path} has a tensor of the type {value}, unknown to ONNX; export it again")
            elif number == 1:
                shape.extend(self._reader.integers(value, first, last))
        n_values = math.prod(shape[:64])
        self._n_weight_bytes += n_bytes
        if self._trusted:
            return name, 0
        # The smallest type takes two bits; onnxruntime takes memory by the shape before it looks at the content.
        if len(shape) > 64 or n_values > 4 * n_bytes:
            shown = f"{len(shape)} axes" if len(shape) > 64 else f"shape {tuple(shape)}"
            raise ModelFileError(f"{self._path} has a tensor of {shown} in {n_bytes} bytes; export it again")
        if self._n_weight_bytes > MAX_WEIGHT_BYTES:
            self._refuse_unless_trusted(f"has more than {MAX_WEIGHT_BYTES} bytes of weights")
        return name, n_values

"""LLVM's assembly language, written operation by operation.

Place in the pipeline: **builder** -> arithmetic, loops, emission -> machine_code.

Every value of a program is a vector over lanes; a lane is a sample, and no operation looks from one lane at another,
but for the decision whether a loop goes on or a branch is entered at all.  The text is the same for any number of
lanes: it has marks in place of the types, which `filled` fills in.  With a single lane there are no vectors, of which
LLVM's fast selection knows none of one entry: what it does not know takes three times as long.

    #d #b #i #u #l vectors of double, of i1, of i32 (twice), of i64
    #p             a vector of pointers
    #v             v8 for eight lanes: so a type begins in the name of an intrinsic function
    #(k)           the size of k vectors of 8 bytes a lane, in bytes
    #lanes         0, 8, 16, ...: the place of every lane within such a vector, in bytes
    #[a|b]         a for vectors, b for a single lane
    splat (n)      a number in all lanes

A value is in a register, or in the workspace: memory of the caller, in slots of 8 bytes a lane.  What goes around in a
loop is kept in slots, which keeps the time of compilation linear in the length of the program; so does a new basic
block after every few hundred operations.
"""

import re
import struct
from collections.abc import Callable, Hashable
from typing import Any, cast

import numpy as np

OPERATIONS_OF_A_BLOCK = 300
MOST_OPERATIONS = 2_000_000  # of a program: LLVM takes 20 us for each, and some kB of memory; XLA far more
FUSED_FROM = 64  # turns: with fewer, the fast selection takes longer for fused sums than these save
TURNS = 8  # of a loop, where it is not known how many there will be
ALTERNATIVES = re.compile(r"#\[(.*?)\|(.*?)\]")
MARKS = re.compile(r"#(?:\((-?\d+)\)|lanes|[dbiulpv])")
SPLAT = re.compile(r"splat \(\w+ (\S+)\)")


class Value:
    """A vector over lanes in a register: its name, and its kind (d: double, b: bool, i: int32, u: uint32, l: int64).

    Not a tuple: NumPy would take it apart.
    """

    __slots__ = ("kind", "name")

    def __init__(self, name: str, kind: str) -> None:
        self.name, self.kind = name, kind


class Product(Value):
    """A product of doubles, whose factors a fused sum takes in its place; alone: whether anything else reads it."""

    __slots__ = ("alone", "factors", "line", "register", "turns")

    def __init__(self, register: str, factors: tuple[str, str], line: int, turns: int) -> None:
        self.register, self.kind, self.factors, self.line, self.turns = register, "d", factors, line, turns
        self.alone = False

    @property
    def name(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride] # noted when it is read
        self.alone = True
        return self.register


Rows = tuple[tuple[str, int], ...]  # numbers of rows (scalars), and how many slots such a row has


class Stored(Value):
    """A value in the workspace that is written no more while it is in use: loaded where it is used.

    It is in a slot, or so many rows after it.
    """

    __slots__ = ("builder", "rows", "slot")

    def __init__(self, builder: "Builder", kind: str, slot: int, rows: Rows = ()) -> None:
        self.builder, self.kind, self.slot, self.rows = builder, kind, slot, rows

    @property
    def name(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride] # computed where it is used
        return self.builder.load_once(self.kind, self.slot, self.rows).name


Entry = Any  # of an array: a `Value`, or a number of NumPy's that is known


class Unsupported(Exception):
    """An operation that has no machine code here; the text names it."""


class TooLarge(Unsupported):
    """More operations than machine code is made of."""


def kind_of(dtype: Any) -> str:
    """The kind of values of a type of numbers, or of another type of JAX's, such as that of random keys.

    **Raises:** `Unsupported` for a type without one.
    """
    name = str(getattr(dtype, "name", dtype))
    found = {"float64": "d", "bool": "b", "int32": "i", "uint32": "u", "int64": "l"}.get(name)
    if found is None:
        raise Unsupported(f"numbers of type {name}")
    return found


DTYPES = {
    "d": np.dtype(float), "b": np.dtype(bool), "i": np.dtype(np.int32), "u": np.dtype(np.uint32),
    "l": np.dtype(np.int64),
}  # fmt: skip


def is_known(entry: Entry) -> bool:
    return not isinstance(entry, Value)


class Builder:
    """A function `void (ptr workspace)` of one block of lanes, under construction.

    Operations that were carried out already, with the same operands, are not repeated.  Values have numbers in place of
    names, of which LLVM keeps no table: it reads them in half the time.

    **Arguments:** `immediate`: known numbers are written into the operations, in a short function that is called often;
    else they are loaded from the stack, since LLVM's fast selection knows no vectors of numbers, and leaves all of a
    block that is before one to a selection that takes three times as long; `fuses`: sums of products in long loops are
    rounded once, wherever one is written, by whatever number of lanes.
    """

    def __init__(self, immediate: bool = False, fuses: bool = False) -> None:
        self.immediate, self.fuses = immediate, fuses
        self.numbers: dict[str, str] = {}  # known ones, and where they are on the stack
        self.lines: list[str] = []
        self.block = "entry"
        self.operations = self.work = 0
        self.slots = 0
        self.intrinsics: dict[str, str] = {}
        self.tables: dict[str, str] = {}  # arrays of known numbers, by their text
        self.functions: dict[str, tuple[int, str]] = {}  # how many results, and text
        self._known: dict[Hashable, Value] = {}  # values of operations, and of slots that are written no more
        self._scopes: list[list[Hashable]] = [[]]  # which of these every scope has found
        self._products: list[Product] = []
        self._names = 0
        self._in_block = 0
        self._turns = 1

    # Names and text

    def fresh(self, prefix: str) -> str:
        self._names += 1
        return f"{prefix}{self._names}"

    def line(self, text: str) -> None:
        self.lines.append(text)

    def begin(self, label: str) -> None:
        """A new basic block, to which the last one must have branched."""
        self.line(f"{label}:")
        self.block, self._in_block = label, 0

    def scalar(self, text: str) -> str:
        """An operation whose result is not a vector, such as a loop's counter."""
        self._names += 1
        name = f"%{self._names}"
        self.lines.append(f"{name} = {text}")
        return name

    def beginning(self) -> list[str]:
        """What the function begins with: known numbers are put on the stack."""
        places = [f"{place} = alloca #d" for place in self.numbers.values()]
        return places + [f"store #d {number}, ptr {place}" for number, place in self.numbers.items()]

    def operation(self, kind: str, text: str) -> Value:
        """The value of an operation of vectors that depends on its operands alone."""
        found = self._known.get(text)
        return self._noted(text, self._fresh_value(kind, text)) if found is None else found

    def product(self, left: str, right: str) -> Value:
        """The product of two operands, doubles."""
        text = f"fmul #d {left}, {right}"
        if not self.fuses or self._turns < FUSED_FROM:
            return self.operation("d", text)
        found = self._known.get(text)
        if found is None:
            register = self._fresh_value("d", text).name
            found = self._noted(text, Product(register, (left, right), len(self.lines) - 1, self._turns))
            self._products.append(cast(Product, found))
        return found

    def fused(self, factors: tuple[str, str], term: str) -> Value:
        """The product of two factors plus a term, rounded once."""
        name = "@llvm.fma.#vf64"
        self.intrinsics[name] = f"declare #d {name}(#d, #d, #d)"
        return self.operation("d", f"call #d {name}(#d {factors[0]}, #d {factors[1]}, #d {term})")

    def negated(self, operand: str) -> str:
        """The negative of an operand, a double."""
        return self.operation("d", f"fneg #d {operand}").name

    def finish(self) -> None:
        """Leave out the products that only fused sums have taken."""
        for product in self._products:
            if not product.alone:
                self.lines[product.line] = ""
                self.operations -= 1
                self.work -= product.turns

    def _noted(self, key: Hashable, value: Value) -> Value:
        """The value, which is found again until the scope ends."""
        self._known[key] = value
        self._scopes[-1].append(key)
        return value

    def _fresh_value(self, kind: str, text: str) -> Value:
        self._in_block += 1
        self.operations += 1
        self.work += self._turns
        if self.operations > MOST_OPERATIONS:
            raise TooLarge(f"more than {MOST_OPERATIONS} operations")
        if self._in_block > OPERATIONS_OF_A_BLOCK:
            label = self.fresh("b")
            # LLVM makes one block of two, and takes long for it, where the first can only go on with the second.
            self.line(f"br i1 %never, label %nowhere, label %{label}")
            self.begin(label)
        self._names += 1
        name = f"%{self._names}"
        self.lines.append(f"{name} = {text}")
        return Value(name, kind)

    def operand(self, entry: Entry, kind: str) -> str:
        """An entry as an operand, without its type."""
        if isinstance(entry, Value):
            return entry.name
        if kind == "d":
            number = f"splat (double 0x{struct.pack('>d', float(entry)).hex().upper()})"
            if self.immediate:
                return number
            place = self.numbers.setdefault(number, f"%number{len(self.numbers)}")
            return self.operation("d", f"load #d, ptr {place}").name
        size = {"b": 1, "i": 32, "u": 32, "l": 64}[kind]
        number = "true" if kind == "b" and entry else "false" if kind == "b" else int(entry)
        return f"splat (i{size} {number})"

    def call(self, function: str, kind: str, *entries: Entry) -> Value:
        """An intrinsic function of LLVM, `llvm.NAME`, of doubles."""
        suffix = f"#v{'f64' if kind == 'd' else 'i32' if kind == 'i' else 'i64'}"
        types = ", ".join([f"#{kind}"] * len(entries))
        name = f"@llvm.{function}.{suffix}"
        self.intrinsics[name] = f"declare #{kind} {name}({types})"
        arguments = ", ".join(f"#{kind} {self.operand(x, kind)}" for x in entries)
        return self.operation(kind, f"call #{kind} {name}({arguments})")

    def whole_number(self, kind: str, value: Value) -> Value:
        """A double without its fraction, the nearest number there is, zero of what is not a number: as XLA has it."""
        name = f"@llvm.fpto{'u' if kind == 'u' else 's'}i.sat.#vi{64 if kind == 'l' else 32}.#vf64"
        self.intrinsics[name] = f"declare #{kind} {name}(#d)"
        return self.operation(kind, f"call #{kind} {name}(#d {value.name})")

    def any(self, mask: Value) -> str:
        """Whether a condition holds in any lane, as a scalar."""
        self.intrinsics["any"] = "#[declare i1 @llvm.vector.reduce.or.#vi1(#b)|]"
        return self.scalar(f"#[call i1 @llvm.vector.reduce.or.#vi1(#b {mask.name})|or i1 {mask.name}, false]")

    # Scopes: what was computed in a loop or a branch is not known after it.

    def inside(self, build: Callable[[], None], turns: int = 1) -> None:
        """Build what may be carried out never, or several times: about `turns`."""
        self._scopes.append([])
        self._turns *= turns
        build()
        self._turns //= turns
        for key in self._scopes.pop():
            del self._known[key]

    def counted(self, length: int, turn: Callable[[str], None]) -> None:
        """A loop of a known number of turns, each given the counter, a scalar."""
        loop, done = self.fresh("loop"), self.fresh("done")
        before = self.block
        self.line(f"br label %{loop}")
        place = len(self.lines) + 1
        self.begin(loop)
        counter, following = f"%{self.fresh('i')}", f"%{self.fresh('i')}"
        self.line("")  # for the counter's own line, which names the last block of the loop
        self.inside(lambda: turn(counter), length)
        self.line(f"{following} = add i64 {counter}, 1")
        goes_on = self.scalar(f"icmp ult i64 {following}, {length}")
        self.line(f"br i1 {goes_on}, label %{loop}, label %{done}")
        self.lines[place] = f"{counter} = phi i64 [ 0, %{before} ], [ {following}, %{self.block} ]"
        self.begin(done)

    # The workspace

    def reserve(self, slots: int) -> int:
        """The first of new slots."""
        first = self.slots
        self.slots += slots
        return first

    def address(self, slot: int, rows: Rows = ()) -> str:
        """Address of a slot, or of the one that many rows after it."""
        return self.scalar(f"getelementptr i8, ptr {self._beginning_of(rows)}, i64 #({slot})")

    def _beginning_of(self, rows: Rows) -> str:
        """Address of what would be the first slot, many rows on: an address that is a number away from another one is
        part of the instruction that uses it."""
        if not rows:
            return "%workspace"
        found = self._known.get(rows)
        if found is None:
            *before, (counter, size) = rows
            offset = self.scalar(f"mul i64 {counter}, #({size})")
            place = self.scalar(f"getelementptr i8, ptr {self._beginning_of((*before,))}, i64 {offset}")
            found = self._noted(rows, Value(place, "p"))
        return found.name

    def load(self, kind: str, slot: int, rows: Rows = ()) -> Value:
        """The value in a slot: whole numbers and conditions are kept as 64 bits."""
        place = self.address(slot, rows)
        stored = self._fresh_value("d" if kind == "d" else "l", f"load #{'d' if kind == 'd' else 'l'}, ptr {place}")
        return stored if kind in "dl" else self._fresh_value(kind, f"trunc #l {stored.name} to #{kind}")

    def load_once(self, kind: str, slot: int, rows: Rows = ()) -> Value:
        """The value in a slot that is written no more, loaded already or now."""
        key = kind, slot, rows
        found = self._known.get(key)
        return self._noted(key, self.load(kind, slot, rows)) if found is None else found

    def store(self, entry: Entry, kind: str, slot: int, rows: Rows = ()) -> None:
        """Put an entry into a slot."""
        value = self.operand(entry, kind)
        if kind in "biu":
            value = self.operation("l", f"{'sext' if kind == 'i' else 'zext'} #{kind} {value} to #l").name
        place = self.address(slot, rows)
        self.line(f"store #{'d' if kind == 'd' else 'l'} {value}, ptr {place}")

    def gather(self, kind: str, slot: int, rows: Value) -> Value:
        """Values whose slot differs between lanes: `rows` (int64) after the given one."""
        return self._gathered(kind, self._pointers(slot, rows))

    def _gathered(self, kind: str, pointers: str) -> Value:
        self.intrinsics["gather"] = "#[declare #d @llvm.masked.gather.#vf64.#vp0(#p, i32, #b, #d)|]"
        of_lanes = f"#p {pointers}, i32 8, #b splat (i1 true), #d zeroinitializer"
        text = f"#[call #d @llvm.masked.gather.#vf64.#vp0({of_lanes})|load #d, ptr {pointers}]"
        stored = self._fresh_value("d", text)
        if kind == "d":
            return stored
        bits = self._fresh_value("l", f"bitcast #d {stored.name} to #l")
        return bits if kind == "l" else self._fresh_value(kind, f"trunc #l {bits.name} to #{kind}")

    def table(self, kind: str, numbers: np.ndarray) -> str:
        """The name of an array of known numbers, which is not copied into the workspace."""
        if kind == "d":
            entries = ", ".join(f"double 0x{x.hex().upper()}" for x in map(struct.Struct(">d").pack, numbers.tolist()))
        else:
            entries = ", ".join(f"i64 {int(x)}" for x in numbers)
        text = f"internal constant [{len(numbers)} x {'double' if kind == 'd' else 'i64'}] [{entries}]"
        return self.tables.setdefault(text, f"@table{len(self.tables)}")

    def gather_of_table(self, kind: str, table: str, place: int, rows: Value) -> Value:
        """Numbers of a table, `rows` (int64) after a place."""
        offsets = self.operation("l", f"mul #l {rows.name}, splat (i64 8)")
        base = self.scalar(f"getelementptr i8, ptr {table}, i64 {8 * place}")
        pointers = self.scalar(f"getelementptr i8, ptr {base}, #l {offsets.name}")
        return self._gathered(kind, pointers)

    def store_number(self, kind: str, table: str, place: str, slot: int, rows: Rows) -> None:
        """Put the number of a table that has a place, a scalar, into a slot in all lanes."""
        single, name = ("double", "#d") if kind == "d" else ("i64", "#l")
        at = self.scalar(f"getelementptr {single}, ptr {table}, i64 {place}")
        number = self.scalar(f"load {single}, ptr {at}")
        same = f"bitcast {single} {number} to {single}"
        lane = self.scalar(f"#[insertelement {name} poison, {single} {number}, i64 0|{same}]")
        all_lanes = self.scalar(f"#[shufflevector {name} {lane}, {name} poison, #i zeroinitializer|{same}]")
        self.line(f"store {name} {all_lanes}, ptr {self.address(slot, rows)}")

    def scatter(self, entry: Entry, kind: str, slot: int, rows: Value) -> None:
        """Put an entry into slots that differ between lanes."""
        self.intrinsics["scatter"] = "#[declare void @llvm.masked.scatter.#vf64.#vp0(#d, #p, i32, #b)|]"
        value = self.operand(entry, kind)
        if kind in "biu":
            value = self.operation("l", f"{'sext' if kind == 'i' else 'zext'} #{kind} {value} to #l").name
        if kind != "d":
            value = self.operation("d", f"bitcast #l {value} to #d").name
        pointers = self._pointers(slot, rows)
        of_lanes = f"#d {value}, #p {pointers}, i32 8, #b splat (i1 true)"
        self.line(f"#[call void @llvm.masked.scatter.#vf64.#vp0({of_lanes})|store #d {value}, ptr {pointers}]")

    def _pointers(self, slot: int, rows: Value) -> str:
        bytes_ = self.operation("l", f"mul #l {rows.name}, splat (i64 #(1))")
        within = self.operation("l", f"add #l {bytes_.name}, #lanes")
        base = self.scalar(f"getelementptr i8, ptr %workspace, i64 #({slot})")
        return self.scalar(f"getelementptr i8, ptr {base}, #l {within.name}")


def filled(text: str, lanes: int) -> str:
    """The text with types for a number of lanes."""
    types = {"#d": "double", "#b": "i1", "#i": "i32", "#u": "i32", "#l": "i64", "#p": "ptr"}
    if lanes == 1:
        text = SPLAT.sub(r"\1", ALTERNATIVES.sub(r"\2", text))
        marks = types | {"#v": "", "#lanes": "0"}
    else:
        text = ALTERNATIVES.sub(r"\1", text)
        places = ", ".join(f"i64 {8 * lane}" for lane in range(lanes))
        marks = {mark: f"<{lanes} x {name}>" for mark, name in types.items()}
        marks |= {"#v": f"v{lanes}", "#lanes": f"<{places}>"}
    return MARKS.sub(lambda m: str(8 * lanes * int(m[1])) if m[1] else marks[m[0]], text)

"""Machine code as a function that XLA calls.

Place in the pipeline: programs, machine_code -> **foreign_function** -> primitive.

XLA's foreign-function interface calls `XLA_FFI_Error* handler(XLA_FFI_CallFrame*)`.  The handler written here reads the
pointers to the data out of the call frame (its layout is that of `xla/ffi/api/c_api.h`, which JAX brings along; a test
compares the two), and goes through the samples, as many at a time as there are lanes: the entries of the operands are
copied into the workspace, lane beside lane, the program runs, and its results are copied out of it.  The last block of
samples is filled with copies of the last one.

The last operand says how many samples there are, and for every other one how far (in entries) it is from a sample to
the next: zero if all samples share it.  So one program serves every choice of operands with a batch axis.
"""

import re
from functools import cache
from pathlib import Path
from typing import NamedTuple

# Places in the structures of the call frame, in bytes.
EXTENSION, ARGUMENTS, RESULTS = 8, 72, 112
EXTENSION_TYPE, METADATA, MAJOR, MINOR = 8, 24, 24, 28
DATA = 24
METADATA_EXTENSION = 1

# Of an operand or a result: LLVM's type in XLA's buffer, and what it is in the workspace.
STORED = {
    "d": ("double", "double"), "l": ("i64", "i64"), "i": ("i32", "i64"), "u": ("i32", "i64"), "b": ("i8", "i64"),
}  # fmt: skip


class Buffer(NamedTuple):
    """An array of the program: kind of its entries, their number, and its first slot in the workspace."""

    kind: str
    size: int
    slot: int


@cache
def interface_version() -> tuple[int, int]:
    """Version of the interface, of the header that JAX brings along."""
    import jax

    text = (Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h").read_text(encoding="utf-8")
    major, minor = (re.search(rf"#define XLA_FFI_API_{name} (\d+)", text) for name in ("MAJOR", "MINOR"))
    if major is None or minor is None:
        raise RuntimeError("the header of XLA's foreign-function interface does not say its version")
    return int(major[1]), int(minor[1])


def handler(name: str, operands: list[Buffer], results: list[Buffer], slots: int, lanes: int) -> str:
    """LLVM's text of the handler, which calls `@program(ptr workspace)` for every block of lanes."""
    lines = [
        f"define ptr @{name}(ptr %frame) {{",
        "entry:",
        *_answers_about_itself(),
        "execute:",
        *_pointers(len(operands), len(results)),
        f"%memory = call ptr @malloc(i64 {8 * lanes * max(slots, 1) + 64})",
        "%address = ptrtoint ptr %memory to i64",
        "%over = add i64 %address, 63",
        "%aligned = and i64 %over, -64",
        "%workspace = inttoptr i64 %aligned to ptr",
        "%any = icmp sgt i64 %samples, 0",
        "br i1 %any, label %block, label %done",
        "block:",
        "%first = phi i64 [ 0, %execute ], [ %following, %block ]",
    ]
    for i, (kind, size, slot) in enumerate(operands):
        where = f"ptr %a{i}, i64 %stride{i}, i64 {size}, i64 %first, i64 %samples, ptr %in{i}"
        lines += [
            f"%in{i} = getelementptr i8, ptr %workspace, i64 {8 * lanes * slot}",
            f"call void @copy_in_{kind}({where})",
        ]
    lines += ["call void @program(ptr %workspace)"]
    for i, (kind, size, slot) in enumerate(results):
        where = f"ptr %r{i}, i64 {size}, i64 %first, i64 %samples, ptr %out{i}"
        lines += [
            f"%out{i} = getelementptr i8, ptr %workspace, i64 {8 * lanes * slot}",
            f"call void @copy_out_{kind}({where})",
        ]
    lines += [
        f"%following = add i64 %first, {lanes}",
        "%goes_on = icmp slt i64 %following, %samples",
        "br i1 %goes_on, label %block, label %done",
        "done:",
        "call void @free(ptr %memory)",
        "ret ptr null",
        "}",
        "declare ptr @malloc(i64)",
        "declare void @free(ptr)",
    ]
    lines += [copy_in(kind, lanes) for kind in sorted({b.kind for b in operands})]
    lines += [copy_out(kind, lanes) for kind in sorted({b.kind for b in results})]
    return "\n".join(lines)


def _answers_about_itself() -> list[str]:
    """The beginning of the handler: a frame that asks for its version is told, any other is executed."""
    lines = [
        f"%extension_place = getelementptr i8, ptr %frame, i64 {EXTENSION}",
        "%extension = load ptr, ptr %extension_place",
        "%no_extension = icmp eq ptr %extension, null",
        "br i1 %no_extension, label %execute, label %extended",
        "extended:",
        f"%type_place = getelementptr i8, ptr %extension, i64 {EXTENSION_TYPE}",
        "%type = load i32, ptr %type_place",
        f"%asks = icmp eq i32 %type, {METADATA_EXTENSION}",
        "br i1 %asks, label %tell, label %execute",
        "tell:",
        f"%metadata_place = getelementptr i8, ptr %extension, i64 {METADATA}",
        "%metadata = load ptr, ptr %metadata_place",
    ]
    for place, number in zip((MAJOR, MINOR), interface_version()):
        lines += [f"%p{place} = getelementptr i8, ptr %metadata, i64 {place}", f"store i32 {number}, ptr %p{place}"]
    return [*lines, "ret ptr null"]


def _pointers(operands: int, results: int) -> list[str]:
    """Pointers to the data of operands (%a0, ...) and results (%r0, ...), number of samples, and strides."""
    lines = []
    for letter, place, count in (("a", ARGUMENTS, operands + 1), ("r", RESULTS, results)):
        lines += [
            f"%{letter}_place = getelementptr i8, ptr %frame, i64 {place}",
            f"%{letter}_buffers = load ptr, ptr %{letter}_place",
        ]
        for i in range(count):
            lines += [
                f"%{letter}{i}_place = getelementptr ptr, ptr %{letter}_buffers, i64 {i}",
                f"%{letter}{i}_buffer = load ptr, ptr %{letter}{i}_place",
                f"%{letter}{i}_data = getelementptr i8, ptr %{letter}{i}_buffer, i64 {DATA}",
                f"%{letter}{i} = load ptr, ptr %{letter}{i}_data",
            ]
    lines += [f"%samples = load i64, ptr %a{operands}"]
    for i in range(operands):
        lines += [
            f"%stride{i}_place = getelementptr i64, ptr %a{operands}, i64 {i + 1}",
            f"%stride{i} = load i64, ptr %stride{i}_place",
        ]
    return lines


def copy_in(kind: str, lanes: int) -> str:
    """A function that copies the entries of as many samples as there are lanes into the workspace."""
    outside, inside = STORED[kind]
    widened = {"i": "sext i32 %found to i64", "u": "zext i32 %found to i64", "b": "zext i8 %found to i64"}.get(kind)
    return f"""
define internal void @copy_in_{kind}(ptr %from, i64 %stride, i64 %size, i64 %first, i64 %samples, ptr %to) noinline {{
entry:
  %last = sub i64 %samples, 1
  %some = icmp sgt i64 %size, 0
  br i1 %some, label %lane, label %done
lane:
  %l = phi i64 [ 0, %entry ], [ %l_next, %lane_end ]
  %wanted = add i64 %first, %l
  %beyond = icmp sgt i64 %wanted, %last
  %sample = select i1 %beyond, i64 %last, i64 %wanted
  %start = mul i64 %sample, %stride
  br label %copy
copy:
  %e = phi i64 [ 0, %lane ], [ %e_next, %copy ]
  %place = add i64 %start, %e
  %source = getelementptr {outside}, ptr %from, i64 %place
  %found = load {outside}, ptr %source
  {f"%value = {widened}" if widened else ""}
  %row = mul i64 %e, {lanes}
  %there = add i64 %row, %l
  %target = getelementptr {inside}, ptr %to, i64 %there
  store {inside} {"%value" if widened else "%found"}, ptr %target
  %e_next = add i64 %e, 1
  %more = icmp slt i64 %e_next, %size
  br i1 %more, label %copy, label %lane_end
lane_end:
  %l_next = add i64 %l, 1
  %lanes_left = icmp slt i64 %l_next, {lanes}
  br i1 %lanes_left, label %lane, label %done
done:
  ret void
}}"""


def copy_out(kind: str, lanes: int) -> str:
    """A function that copies the results of the samples of a block out of the workspace."""
    outside, inside = STORED[kind]
    narrowed = {"i": "trunc i64 %found to i32", "u": "trunc i64 %found to i32", "b": "trunc i64 %found to i8"}.get(kind)
    return f"""
define internal void @copy_out_{kind}(ptr %to, i64 %size, i64 %first, i64 %samples, ptr %from) noinline {{
entry:
  %some = icmp sgt i64 %size, 0
  br i1 %some, label %lane, label %done
lane:
  %l = phi i64 [ 0, %entry ], [ %l_next, %lane_end ]
  %sample = add i64 %first, %l
  %exists = icmp slt i64 %sample, %samples
  %start = mul i64 %sample, %size
  br i1 %exists, label %copy, label %done
copy:
  %e = phi i64 [ 0, %lane ], [ %e_next, %copy ]
  %row = mul i64 %e, {lanes}
  %there = add i64 %row, %l
  %source = getelementptr {inside}, ptr %from, i64 %there
  %found = load {inside}, ptr %source
  {f"%value = {narrowed}" if narrowed else ""}
  %place = add i64 %start, %e
  %target = getelementptr {outside}, ptr %to, i64 %place
  store {outside} {"%value" if narrowed else "%found"}, ptr %target
  %e_next = add i64 %e, 1
  %more = icmp slt i64 %e_next, %size
  br i1 %more, label %copy, label %lane_end
lane_end:
  %l_next = add i64 %l, 1
  %lanes_left = icmp slt i64 %l_next, {lanes}
  br i1 %lanes_left, label %lane, label %done
done:
  ret void
}}"""

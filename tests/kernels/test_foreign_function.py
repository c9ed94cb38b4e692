"""The layout of XLA's call frame is that of the header that JAX brings along."""

import ctypes
import re
from pathlib import Path

import jax.ffi

from rfem_jax.kernels import foreign_function

HEADER = (Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h").read_text(encoding="utf-8")
WHOLE = {"size_t": ctypes.c_size_t, "int64_t": ctypes.c_int64, "int32_t": ctypes.c_int32, "int": ctypes.c_int}


def structure(name: str) -> type[ctypes.Structure]:
    """A structure of the header for ctypes: pointers, whole numbers, structures and enumerations."""
    body = re.search(rf"struct {name} \{{(.*?)\n\}}", HEADER, re.DOTALL)
    assert body, name
    text = re.sub(r"//[^\n]*", "", body[1])
    fields = []
    for declaration in filter(None, (part.strip() for part in text.split(";"))):
        kind, field = re.fullmatch(r"(.*?)\s*(\w+)(?:\[\w*\])?", declaration, re.DOTALL).groups()
        fields.append((field, type_of(kind.replace("const ", "").strip())))
    return type(name, (ctypes.Structure,), {"_fields_": fields})


def type_of(kind: str):
    if kind.endswith("*"):
        return ctypes.c_void_p
    if kind in WHOLE:
        return WHOLE[kind]
    kind = kind.removeprefix("struct ")
    if re.search(rf"struct {kind} \{{", HEADER):
        return structure(kind)
    assert re.search(rf"(\}}|uint32_t) {kind};", HEADER), kind
    return ctypes.c_int  # an enumeration, or flags


def test_places_in_the_call_frame():
    frame, buffer = structure("XLA_FFI_CallFrame"), structure("XLA_FFI_Buffer")
    arguments, results = structure("XLA_FFI_Args"), structure("XLA_FFI_Rets")
    assert frame.extension_start.offset == foreign_function.EXTENSION
    assert frame.args.offset + arguments.args.offset == foreign_function.ARGUMENTS
    assert frame.rets.offset + results.rets.offset == foreign_function.RESULTS
    assert buffer.data.offset == foreign_function.DATA


def test_places_in_the_question_for_metadata():
    # Newer headers call the first an internal one.
    base = "XLA_FFI_InternalExtension" if "struct XLA_FFI_InternalExtension {" in HEADER else "XLA_FFI_Extension_Base"
    extension, asked = structure(base), structure("XLA_FFI_Metadata_Extension")
    metadata, version = structure("XLA_FFI_Metadata"), structure("XLA_FFI_Api_Version")
    assert extension.type.offset == foreign_function.EXTENSION_TYPE
    assert asked.metadata.offset == foreign_function.METADATA
    assert metadata.api_version.offset + version.major_version.offset == foreign_function.MAJOR
    assert metadata.api_version.offset + version.minor_version.offset == foreign_function.MINOR
    number = re.search(r"XLA_FFI_Extension_Metadata = (\d+)", HEADER)
    assert number and int(number[1]) == foreign_function.METADATA_EXTENSION


def test_the_version_is_that_of_the_header():
    major, minor = foreign_function.interface_version()
    assert f"#define XLA_FFI_API_MAJOR {major}\n" in HEADER and f"#define XLA_FFI_API_MINOR {minor}\n" in HEADER

"""Named tuples of arrays that kernels hand on as one pointer.

numba spreads a tuple over the arguments of every call: of the three tuples of a run that makes
some seven hundred values a call, most of them for the compiler to move around. Registered here, a
named tuple of arrays becomes a pointer to the descriptors of its arrays, which stay where the
Python entry of the outermost kernel has put them. Attributes read as before.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.imputils import impl_ret_borrowed
from numba.core.typing.templates import AttributeTemplate
from numba.extending import (
    NativeValue,
    infer_getattr,
    lower_getattr_generic,
    models,
    register_model,
    typeof_impl,
    unbox,
)


class Pack(types.Type):
    """Type of a named tuple of arrays."""

    def __init__(self, name: str, fields: tuple[tuple[str, Any], ...]) -> None:
        self.fields = dict(fields)
        arrays = ", ".join(f"{field}: {kind}" for field, kind in fields)
        super().__init__(name=f"Pack({name}, {arrays})")


@register_model(Pack)
class PackModel(models.OpaqueModel):
    """A pointer."""


def _descriptors(context: Any, pack: Pack) -> Any:
    """LLVM type of the descriptors of all arrays, one after the other."""
    return ir.LiteralStructType([context.get_value_type(kind) for kind in pack.fields.values()])


@unbox(Pack)
def unbox_pack(typ: Pack, obj: Any, c: Any) -> NativeValue:
    """Put the descriptors on the entry's stack."""
    place = cgutils.alloca_once(c.builder, _descriptors(c.context, typ), zfill=True)
    failed = cgutils.alloca_once_value(c.builder, cgutils.false_bit)
    for k, kind in enumerate(typ.fields.values()):
        item = c.pyapi.tuple_getitem(obj, k)
        native = c.unbox(kind, item)
        with c.builder.if_then(native.is_error, likely=False):
            c.builder.store(cgutils.true_bit, failed)
        c.builder.store(native.value, cgutils.gep_inbounds(c.builder, place, 0, k))
    # What comes out of the (empty) assembly depends on the stores above: no read that is marked as
    # invariant can move before them, even where the kernel is inlined here.
    pointer = c.builder.asm(
        ir.FunctionType(cgutils.voidptr_t, [cgutils.voidptr_t]),
        "", "=r,0,~{memory}", [c.builder.bitcast(place, cgutils.voidptr_t)], side_effect=True,
    )  # fmt: skip
    return NativeValue(pointer, is_error=c.builder.load(failed))


@infer_getattr
class PackAttribute(AttributeTemplate):
    """The arrays by name."""

    key = Pack

    def generic_resolve(self, typ: Pack, attr: str) -> Any:
        return typ.fields.get(attr)


@lower_getattr_generic(Pack)
def get_array(context: Any, builder: Any, typ: Pack, value: Any, attr: str) -> Any:
    """Read an array's descriptor.

    It does not change while kernels run, whatever they write: the reads are marked as invariant,
    so that none stays in a loop.
    """
    kind = typ.fields[attr]
    k = list(typ.fields).index(attr)
    place = builder.bitcast(value, _descriptors(context, typ).as_pointer())
    array = context.make_array(kind)(context, builder)
    nothing = builder.module.add_metadata([])

    def read(*path: int) -> Any:
        load = builder.load(cgutils.gep_inbounds(builder, place, 0, k, *path))
        load.set_metadata("invariant.load", nothing)
        return load

    model = context.data_model_manager[kind]
    for position, field in enumerate(model._fields):
        if field in ("shape", "strides"):
            items = [read(position, d) for d in range(kind.ndim)]
            setattr(array, field, cgutils.pack_array(builder, items))
        else:
            setattr(array, field, read(position))
    return impl_ret_borrowed(context, builder, kind, array._getvalue())


def register(kind: type) -> None:
    """Hand on the named tuples of a class as pointers."""

    @typeof_impl.register(kind)
    def typeof_pack(value: Any, c: Any) -> Pack:
        fields = tuple((name, typeof_impl(a, c)) for name, a in zip(value._fields, value))
        return Pack(kind.__name__, fields)

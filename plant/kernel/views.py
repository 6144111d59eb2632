"""Views: bare pointers into a kernel's arrays, as cheap to pass as a number.

numba passes an array as seven values and counts the references to every slice; a view is one
pointer, and the kernels run in half the time.  `v[i]` is element i, `v[a:]` the view from element a
on; a view with rows takes `v[i, j]`, and `v[i]` is row i.  A view of a record (`plant.kernel.records`)
has its fields as attributes: `p.leak_atm`.  A lane view is one of `width` interleaved copies
(structure of arrays), so that the same equations run on many strokes at the same time.  Compiled
views check no bounds; with OPC4_CHECKED_KERNELS=1 the kernels run as plain Python on
`plant.kernel.checked`, which does.

Checked by: tests/unit/plant/kernel/test_views.py
"""

from __future__ import annotations

import operator

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.core.errors import TypingError
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import AbstractTemplate, AttributeTemplate, infer_global, signature
from numba.extending import (
    infer_getattr,
    intrinsic,
    lower_cast,
    lower_getattr_generic,
    lower_setattr_generic,
    models,
    register_model,
)

from plant.kernel.compiled import CHECKED
from plant.kernel.records import RECORDS, Record


class View(types.Type):
    """Type of a view.

    dtype: of its elements; width: distance between neighbours; length: of a row, 0 without rows;
    record: name of the record, if it is one; zeros: names of its fields that read as 0; discards: True
    if nothing is written.
    """

    def __init__(
        self, dtype, width=1, length=0, record="", zeros: tuple[str, ...] = (), discards=False
    ) -> None:
        self.dtype = dtype
        self.width = width
        self.length = length
        self.record = record
        self.zeros = zeros
        self.discards = discards
        super().__init__(name=f"View({dtype},{width},{length},{record},{zeros},{discards})")

    def field(self, name: str):
        """Return the field of that name, None if there is none."""
        return RECORDS[self.record].fields.get(name) if self.record else None


@register_model(View)
class ViewModel(models.PrimitiveModel):
    """A view is a pointer to its first element."""

    def __init__(self, manager, view_type) -> None:
        element = manager.lookup(view_type.dtype).get_data_type()
        super().__init__(manager, view_type, element.as_pointer())


def _element(builder, pointer, width, index):
    if width != 1:
        index = builder.mul(index, ir.Constant(index.type, width))
    return builder.gep(pointer, [index])


@intrinsic
def _view(typing_context, array, offset):
    """View of a C-contiguous array from element `offset` on."""
    if not isinstance(array, types.Array) or array.layout != "C":
        raise TypingError("a view needs a C-contiguous array")
    signature = View(array.dtype)(array, types.intp)

    def generate(context, builder, signature, arguments):
        whole = context.make_array(signature.args[0])(context, builder, arguments[0])
        return builder.gep(whole.data, [arguments[1]])

    return signature, generate


@intrinsic(prefer_literal=True)
def _lane(typing_context, v, index, width):
    """Lane `index` of `width` (a constant) interleaved copies: element i is v[i width + index]."""
    result = View(v.dtype, width.literal_value)

    def generate(context, builder, signature, arguments):
        return builder.gep(arguments[0], [arguments[1]])

    return result(v, types.intp, width), generate


@intrinsic
def _discarding(typing_context, v):
    """Return the same view, to which nothing is written."""

    def generate(context, builder, signature, arguments):
        return arguments[0]

    return View(v.dtype, v.width, v.length, discards=True)(v), generate


def _named(record: type[Record], zeros: tuple[str, ...] = ()):
    """Return the function that makes a view, or a C-contiguous array, a view of a record.

    zeros: fields that read as 0, and what depends on them is compiled away.
    """
    name = record.__name__

    @intrinsic
    def named(typing_context, v):
        if not isinstance(v, View) and not (isinstance(v, types.Array) and v.layout == "C"):
            raise TypingError(f"{name} needs a view or a C-contiguous array")
        width = v.width if isinstance(v, View) else 1

        def generate(context, builder, signature, arguments):
            if isinstance(signature.args[0], View):
                return arguments[0]
            whole = context.make_array(signature.args[0])(context, builder, arguments[0])
            return whole.data

        return View(v.dtype, width, 0, name, zeros)(v), generate

    return named


@infer_global(operator.getitem)
class Read(AbstractTemplate):
    """`v[i]`, `v[i, j]`, the view `v[a:]`, and the row `v[i]` of a view with rows."""

    def generic(self, args, kws):
        """Return the signature."""
        v, i = args
        if not isinstance(v, View):
            return None
        tail = isinstance(i, types.SliceType)
        row = v.length and not isinstance(i, types.BaseTuple)
        result = View(v.dtype, v.width) if tail or row else v.dtype
        return signature(result, v, i if isinstance(i, types.BaseTuple) or tail else types.intp)


@infer_global(operator.setitem)
class Write(AbstractTemplate):
    """`v[i] = value` and `v[i, j] = value`."""

    def generic(self, args, kws):
        """Return the signature."""
        v, i, _value = args
        if not isinstance(v, View):
            return None
        return signature(
            types.none, v, i if isinstance(i, types.BaseTuple) else types.intp, v.dtype
        )


def _indexed(context, builder, v, pointer, index_type, index):
    """Return the pointer that an index selects."""
    if isinstance(index_type, types.SliceType):
        index = context.make_helper(builder, index_type, index).start
    elif isinstance(index_type, types.BaseTuple):
        i, j = (
            context.cast(builder, part, kind, types.intp)
            for part, kind in zip(cgutils.unpack_tuple(builder, index), index_type, strict=True)
        )
        index = builder.add(builder.mul(i, ir.Constant(i.type, v.length)), j)
    elif v.length:
        index = builder.mul(index, ir.Constant(index.type, v.length))
    return _element(builder, pointer, v.width, index)


@lower_builtin(operator.getitem, View, types.Any)
def _read(context, builder, signature, arguments):
    v, index_type = signature.args
    pointer = _indexed(context, builder, v, arguments[0], index_type, arguments[1])
    return pointer if isinstance(signature.return_type, View) else builder.load(pointer)


@lower_builtin(operator.setitem, View, types.Any, types.Any)
def _write(context, builder, signature, arguments):
    v, index_type, _ = signature.args
    if not v.discards:
        pointer = _indexed(context, builder, v, arguments[0], index_type, arguments[1])
        builder.store(arguments[2], pointer)
    return context.get_dummy_value()


@infer_getattr
class Fields(AttributeTemplate):
    """Attributes of a view of a record: one number, or a view of several."""

    key = View

    def generic_resolve(self, value, attribute):
        """Return the type of a field."""
        field = value.field(attribute)
        if field is None:
            return None
        return View(value.dtype, value.width, field.row) if field.length else value.dtype


@intrinsic
def call_compiled(typing_context, address, slot, t, x, v, direction, pressure, values):
    """Call the compiled function at an address: double f(six doubles, pointer to doubles)."""
    number = types.float64

    def generate(context, builder, signature, arguments):
        double = ir.DoubleType()
        kind = ir.FunctionType(double, [double] * 6 + [double.as_pointer()])
        function = builder.inttoptr(arguments[0], kind.as_pointer())
        # "readonly" keeps the compiler from reading every parameter again after the call
        return builder.call(function, arguments[1:], attrs=("readonly", "nounwind"))

    return number(types.int64, *[number] * 6, values), generate


@intrinsic
def moved_pointer(typing_context, pointer, count):
    """Return a pointer `count` elements further on."""

    def generate(context, builder, signature, arguments):
        return builder.gep(arguments[0], [arguments[1]])

    return pointer(pointer, types.intp), generate


@intrinsic
def _unlikely(typing_context, condition):
    """Return a condition that is rarely true: the compiler moves what depends on it out of the way."""

    def generate(context, builder, signature, arguments):
        bit = ir.IntType(1)
        kind = ir.FunctionType(bit, [bit, bit])
        expect = builder.module.declare_intrinsic("llvm.expect", [bit], kind)
        return builder.call(expect, [arguments[0], bit(0)])

    return types.boolean(types.boolean), generate


def _pointer(context, builder, v, pointer, field):
    return _element(builder, pointer, v.width, context.get_constant(types.intp, field.start))


@lower_getattr_generic(View)
def _get(context, builder, v, pointer, attribute):
    field = v.field(attribute)
    if field.length:
        return _pointer(context, builder, v, pointer, field)
    if attribute in v.zeros:
        return context.get_constant(v.dtype, 0)
    return builder.load(_pointer(context, builder, v, pointer, field))


@lower_setattr_generic(View)
def _set(context, builder, signature, arguments, attribute):
    v = signature.args[0]
    pointer, value = arguments
    if not v.discards:
        builder.store(value, _pointer(context, builder, v, pointer, v.field(attribute)))


@lower_cast(types.IntEnumMember, types.Float)
def _enumerated(context, builder, member, number, value):
    """Compare members of the enumerations with elements of float arrays."""
    return context.cast(builder, value, member.dtype, number)


if CHECKED:
    from plant.kernel.checked import call_at, discarding, lane, named, unlikely, view
else:
    view, lane, discarding, named = _view, _lane, _discarding, _named
    call_at, unlikely = call_compiled, _unlikely

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
# mypy: disallow-untyped-defs=False

from __future__ import annotations

import operator

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core.errors import TypingError
from numba.core.typing.templates import AttributeTemplate
from numba.extending import (
    infer_getattr,
    intrinsic,
    lower_cast,
    lower_getattr_generic,
    lower_setattr_generic,
    models,
    overload,
    register_model,
)

from plant.kernel import checked
from plant.kernel.compiled import CHECKED
from plant.kernel.records import RECORDS, Record

# Name of a set of elements -> bit mask of those known to be 0 (see `lane`).
ABSENT: dict[str, int] = checked.ABSENT
HALF = 62  # bits of a mask that fit one positive int64


class View(types.Type):
    """Type of a view.

    dtype: of its elements; width: distance between neighbours; length: of a row, 0 without rows;
    absent: name of the set of elements that read as 0; record: name of the record, if it is one.
    """

    def __init__(
        self, dtype, width: int = 1, length: int = 0, absent: str = "", record: str = ""
    ) -> None:
        self.dtype = dtype
        self.width = width
        self.length = length
        self.absent = absent
        self.record = record
        super().__init__(name=f"View({dtype},{width},{length},{absent},{record})")

    def field(self, name: str):
        """Return the field of that name, None if there is none."""
        return RECORDS[self.record].fields.get(name) if self.record else None

    def reads_zero(self, index: int) -> bool:
        """Return True if an element is known to be 0."""
        return bool(ABSENT[self.absent] >> index & 1)


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
def _rows(typing_context, v, length):
    """Return the same view, read as rows of `length` elements (a constant)."""
    result = View(v.dtype, v.width, length.literal_value)

    def generate(context, builder, signature, arguments):
        return arguments[0]

    return result(v, length), generate


@intrinsic(prefer_literal=True)
def _lane(typing_context, v, block, index, width, absent):
    """Lane `index` of `width` interleaved copies, from row `block` on.

    Element i is v[(block + i) width + index].  `absent` names a set of ABSENT: those elements read
    as 0, and what depends on them is compiled away.  "discarded": nothing is written.
    """
    step = width.literal_value
    result = View(v.dtype, step, 0, absent.literal_value)

    def generate(context, builder, signature, arguments):
        start = builder.mul(arguments[1], ir.Constant(arguments[1].type, step))
        return builder.gep(arguments[0], [builder.add(start, arguments[2])])

    return result(v, types.intp, types.intp, width, absent), generate


@intrinsic(prefer_literal=True)
def _copy_row(typing_context, v, source, target, width):
    """Copy `width` (a constant) neighbours from element `source` on to `target` on, as one vector."""
    lanes = width.literal_value

    def generate(context, builder, signature, arguments):
        pointer, source, target, _ = arguments
        row = ir.VectorType(pointer.type.pointee, lanes).as_pointer()
        values = builder.load(builder.bitcast(builder.gep(pointer, [source]), row), align=8)
        builder.store(values, builder.bitcast(builder.gep(pointer, [target]), row), align=8)
        return context.get_dummy_value()

    return types.void(v, types.intp, types.intp, width), generate


def _named(record: type[Record], absent: str = ""):
    """Return the function that makes a view, or a C-contiguous array, a view of a record.

    `absent` names a set of ABSENT: fields that read as 0, and what depends on them is compiled away.
    """
    name = record.__name__

    @intrinsic
    def named(typing_context, v):
        if isinstance(v, View):
            signature = View(v.dtype, v.width, 0, absent or v.absent, name)(v)
        elif isinstance(v, types.Array) and v.layout == "C":
            signature = View(v.dtype, 1, 0, absent, name)(v)
        else:
            raise TypingError(f"{name} needs a view or a C-contiguous array")

        def generate(context, builder, signature, arguments):
            if isinstance(signature.args[0], View):
                return arguments[0]
            whole = context.make_array(signature.args[0])(context, builder, arguments[0])
            return whole.data

        return signature, generate

    return named


@intrinsic
def _load(typing_context, v, index):
    def generate(context, builder, signature, arguments):
        width = signature.args[0].width
        return builder.load(_element(builder, arguments[0], width, arguments[1]))

    return v.dtype(v, types.intp), generate


@intrinsic
def _store(typing_context, v, index, value):
    def generate(context, builder, signature, arguments):
        width = signature.args[0].width
        builder.store(arguments[2], _element(builder, arguments[0], width, arguments[1]))
        return context.get_dummy_value()

    return types.void(v, types.intp, v.dtype), generate


@intrinsic
def _from(typing_context, v, index):
    def generate(context, builder, signature, arguments):
        return _element(builder, arguments[0], signature.args[0].width, arguments[1])

    return View(v.dtype, v.width)(v, types.intp), generate


@overload(operator.getitem)
def _read(v, i):
    if not isinstance(v, View):
        return None
    length = v.length
    if isinstance(i, types.SliceType):
        return lambda v, i: _from(v, i.start)
    if isinstance(i, types.BaseTuple):
        return lambda v, i: _load(v, i[0] * length + i[1])
    if length:
        return lambda v, i: _from(v, i * length)
    if not v.absent:
        return lambda v, i: _load(v, i)
    mask = ABSENT[v.absent]
    low = mask & ((1 << HALF) - 1)
    high = mask >> HALF
    zero = v.dtype(0)

    def read(v, i):
        if (low >> i) & 1 if i < HALF else (high >> (i - HALF)) & 1:
            return zero
        return _load(v, i)

    return read


@overload(operator.setitem)
def _write(v, i, value):
    if not isinstance(v, View):
        return None
    length = v.length
    if v.absent == "discarded":
        return lambda v, i, value: None
    if isinstance(i, types.BaseTuple):
        return lambda v, i, value: _store(v, i[0] * length + i[1], value)
    return lambda v, i, value: _store(v, i, value)


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
    if v.reads_zero(field.start):
        return context.get_constant(v.dtype, 0)
    return builder.load(_pointer(context, builder, v, pointer, field))


@lower_setattr_generic(View)
def _set(context, builder, signature, arguments, attribute):
    v = signature.args[0]
    pointer, value = arguments
    if v.absent != "discarded":
        builder.store(value, _pointer(context, builder, v, pointer, v.field(attribute)))


@lower_cast(types.IntEnumMember, types.Float)
def _enumerated(context, builder, member, number, value):
    """Compare members of the enumerations with elements of float arrays."""
    return context.cast(builder, value, member.dtype, number)


if CHECKED:
    from plant.kernel.checked import call_at, copy_row, lane, named, rows, unlikely, view
else:
    view, rows, lane, copy_row, named = _view, _rows, _lane, _copy_row, _named
    call_at, unlikely = call_compiled, _unlikely

"""Views: bare pointers into a kernel's arrays, as cheap to pass as a number; twice as fast as numba's arrays.

`v[i]` is element i, `v[a:]` the view from element a on; a view with rows takes `v[i, j]`, and `v[i]` is row i.  A view
of a record (`plant.kernel.records`) has its fields as attributes: `p.leak_atm`.  A lane view is one of `width`
interleaved copies, so that the same equations run on many strokes at the same time.  Compiled views check no bounds;
with OPC4_CHECKED_KERNELS=1 the kernels run as plain Python on `plant.kernel.checked`, which does.
"""

from __future__ import annotations

import operator

from numba import errors, extending, types

# numba.extending has no base for attributes but `overload_attribute`, a function compiled for each of
# some hundred fields: a third more time for the first compilation
from numba.core.typing.templates import AttributeTemplate

from plant.kernel.compiled import CHECKED, announce
from plant.kernel.records import RECORDS, Record

TERM = types.float64(*[types.float64] * 6, types.CPointer(types.float64))
"""Signature of a compiled term: six numbers and a pointer to its values."""


class View(types.Type):
    """Type of a view: dtype of its elements, width between neighbours, length of a row (0 without rows).

    record: name of the record, if it is one; zeros: names of its fields that read as 0; discards: True if nothing is
    written.
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


@extending.register_model(View)
class ViewModel(extending.models.PrimitiveModel):
    """A view is a pointer to its first element."""

    def __init__(self, manager, view_type) -> None:
        element = manager.lookup(view_type.dtype).get_data_type()
        super().__init__(manager, view_type, element.as_pointer())


def _is_contiguous(array) -> bool:
    return isinstance(array, types.Array) and array.layout == "C"


def _pointer_of(context, builder, kind, value):
    """Return the pointer to the first element of a view or an array."""
    return (
        value if isinstance(kind, View) else context.make_array(kind)(context, builder, value).data
    )


def _cast_pointer(context, builder, signature, arguments):
    return _pointer_of(context, builder, signature.args[0], arguments[0])


def _move_pointer(context, builder, signature, arguments):
    pointer = _pointer_of(context, builder, signature.args[0], arguments[0])
    return builder.gep(pointer, [arguments[1]])


@extending.intrinsic
def _view(typing_context, array, offset):
    """View of a C-contiguous array from element `offset` on."""
    if not _is_contiguous(array):
        raise errors.TypingError("a view needs a C-contiguous array")
    return View(array.dtype)(array, types.intp), _move_pointer


@extending.intrinsic(prefer_literal=True)
def _lane(typing_context, v, index, width):
    """Lane `index` of `width` (a constant) interleaved copies: element i is v[i width + index]."""
    return View(v.dtype, width.literal_value)(v, types.intp, width), _move_pointer


@extending.intrinsic
def _discarding(typing_context, v):
    """Return the same view, to which nothing is written."""
    return View(v.dtype, v.width, v.length, discards=True)(v), _cast_pointer


def _named(record: type[Record], zeros: tuple[str, ...] = ()):
    """Return the function that makes a view or C-contiguous array one of a record; `zeros`: fields that read as 0."""
    name = record.__name__

    @extending.intrinsic
    def named(typing_context, v):
        announce()
        if not isinstance(v, View) and not _is_contiguous(v):
            raise errors.TypingError(f"{name} needs a view or a C-contiguous array")
        width = v.width if isinstance(v, View) else 1
        return View(v.dtype, width, 0, name, zeros)(v), _cast_pointer

    return named


@extending.intrinsic
def moved_pointer(typing_context, pointer, count):
    """Return a pointer `count` elements further on."""

    def generate(context, builder, signature, arguments):
        return builder.gep(arguments[0], [arguments[1]])

    return pointer(pointer, types.intp), generate


@extending.intrinsic
def call_compiled(typing_context, address, slot, t, x, v, direction, pressure, values):
    """Call the compiled term at an address."""

    def generate(context, builder, signature, arguments):
        kind = context.get_value_type(types.ExternalFunctionPointer(TERM, None))
        function = builder.inttoptr(arguments[0], kind)
        # "readonly" keeps the compiler from reading every parameter again after the call
        return builder.call(function, arguments[1:], attrs=("readonly", "nounwind"))

    return TERM.return_type(types.int64, *TERM.args[:-1], values), generate


@extending.intrinsic
def _unlikely(typing_context, condition):
    """Return a condition that is rarely true: the compiler moves what depends on it out of the way."""
    both = types.ExternalFunctionPointer(types.boolean(types.boolean, types.boolean), None)

    def generate(context, builder, signature, arguments):
        bit = arguments[0].type
        kind = context.get_value_type(both).pointee
        expect = builder.module.declare_intrinsic("llvm.expect", [bit], kind)
        return builder.call(expect, [arguments[0], bit(0)])

    return types.boolean(types.boolean), generate


def _selected_type(v, index):
    """Return the type of `v[index]`: an element, or the view `v[a:]` or of a row."""
    is_row = v.length and not isinstance(index, types.BaseTuple)
    return View(v.dtype, v.width) if is_row or isinstance(index, types.SliceType) else v.dtype


@extending.type_callable(operator.getitem)
def _type_of_read(context):
    return lambda v, index: _selected_type(v, index) if isinstance(v, View) else None


@extending.type_callable(operator.setitem)
def _type_of_write(context):
    return lambda v, index, value: types.none if isinstance(v, View) else None


def _element(builder, v, pointer, index):
    return builder.gep(
        pointer, [builder.mul(index, index.type(v.width)) if v.width != 1 else index]
    )


def _selected(context, builder, v, pointer, index_type, index):
    """Return the pointer that an index selects."""
    if isinstance(index_type, types.SliceType):
        index = context.make_helper(builder, index_type, index).start
    elif isinstance(index_type, types.BaseTuple):
        i, j = (
            context.cast(builder, builder.extract_value(index, k), kind, types.intp)
            for k, kind in enumerate(index_type)
        )
        index = builder.add(builder.mul(i, i.type(v.length)), j)
    else:
        index = context.cast(builder, index, index_type, types.intp)
        if v.length:
            index = builder.mul(index, index.type(v.length))
    return _element(builder, v, pointer, index)


@extending.lower_builtin(operator.getitem, View, types.Any)
def _read(context, builder, signature, arguments):
    v, index_type = signature.args
    pointer = _selected(context, builder, v, arguments[0], index_type, arguments[1])
    return pointer if isinstance(signature.return_type, View) else builder.load(pointer)


@extending.lower_builtin(operator.setitem, View, types.Any, types.Any)
def _write(context, builder, signature, arguments):
    v, index_type, kind = signature.args
    if not v.discards:
        pointer = _selected(context, builder, v, arguments[0], index_type, arguments[1])
        builder.store(context.cast(builder, arguments[2], kind, v.dtype), pointer)
    return context.get_dummy_value()


def _field_pointer(context, builder, v, pointer, field):
    return _element(builder, v, pointer, context.get_constant(types.intp, field.start))


@extending.infer_getattr
class Fields(AttributeTemplate):
    """Attributes of a view of a record: one number, or a view of several."""

    key = View

    def generic_resolve(self, v, name):
        """Return the type of a field."""
        field = v.field(name)
        if field is None:
            return None
        return View(v.dtype, v.width, field.row) if field.length else v.dtype


@extending.lower_getattr_generic(View)
def _get(context, builder, v, pointer, name):
    field = v.field(name)
    if name in v.zeros:
        return context.get_constant(v.dtype, 0)
    pointer = _field_pointer(context, builder, v, pointer, field)
    return pointer if field.length else builder.load(pointer)


@extending.lower_setattr_generic(View)
def _set(context, builder, signature, arguments, name):
    v = signature.args[0]
    pointer, value = arguments
    if not v.discards:
        builder.store(value, _field_pointer(context, builder, v, pointer, v.field(name)))


@extending.lower_cast(types.IntEnumMember, types.Float)
def _enumerated(context, builder, member, number, value):
    """Compare members of the enumerations with elements of float arrays."""
    return context.cast(builder, value, member.dtype, number)


if CHECKED:
    from plant.kernel.checked import call_at, discarding, lane, named, unlikely, view
else:
    view, lane, discarding, named = _view, _lane, _discarding, _named
    call_at, unlikely = call_compiled, _unlikely

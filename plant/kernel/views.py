"""Views: bare pointers into a kernel's arrays, as light to pass as a number.

numba passes an array as seven values and counts the references to every slice; a view is one
pointer, and the kernels run in half the time.  `v[i]` reads or writes element i, `v[a:]` is the
view from a on; a view with rows takes `v[i, j]`, and `v[i]` is row i.  A lane view is one of
`width` interleaved copies (structure of arrays), so that the same equations run on many strokes
side by side.  No bounds are checked: a view lives inside one kernel call, on arrays it was given.

Checked by: tests/unit/plant/kernel/test_views.py
"""
# mypy: disallow-untyped-defs=False

from __future__ import annotations

import operator

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core.errors import TypingError
from numba.extending import intrinsic, models, overload, register_model

# Name of a set of elements -> bit mask of those known to be 0 (see `lane`).
ABSENT: dict[str, int] = {"": 0, "discarded": 0}
HALF = 62  # bits of a mask that fit one positive int64


class View(types.Type):
    """Type of a view.

    dtype: of its elements; width: distance between neighbours; length: of a row, 0 without rows;
    absent: name of the set of elements that read as 0 without being looked at.
    """

    def __init__(self, dtype, width: int = 1, length: int = 0, absent: str = "") -> None:
        self.dtype = dtype
        self.width = width
        self.length = length
        self.absent = absent
        super().__init__(name=f"View({dtype},{width},{length},{absent})")


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
def view(typing_context, array, offset):
    """View of a C-contiguous array from element `offset` on."""
    if not isinstance(array, types.Array) or array.layout != "C":
        raise TypingError("a view needs a C-contiguous array")
    signature = View(array.dtype)(array, types.intp)

    def generate(context, builder, signature, arguments):
        whole = context.make_array(signature.args[0])(context, builder, arguments[0])
        return builder.gep(whole.data, [arguments[1]])

    return signature, generate


@intrinsic(prefer_literal=True)
def rows(typing_context, v, length):
    """The same view, read as rows of `length` elements (a constant)."""
    result = View(v.dtype, v.width, length.literal_value)

    def generate(context, builder, signature, arguments):
        return arguments[0]

    return result(v, length), generate


@intrinsic(prefer_literal=True)
def lane(typing_context, v, block, index, width, absent):
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
def copy_row(typing_context, v, source, target, width):
    """Copy `width` (a constant) neighbours from element `source` on to `target` on, as one vector."""
    lanes = width.literal_value

    def generate(context, builder, signature, arguments):
        pointer, source, target, _ = arguments
        row = ir.VectorType(pointer.type.pointee, lanes).as_pointer()
        values = builder.load(builder.bitcast(builder.gep(pointer, [source]), row), align=8)
        builder.store(values, builder.bitcast(builder.gep(pointer, [target]), row), align=8)
        return context.get_dummy_value()

    return types.void(v, types.intp, types.intp, width), generate


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

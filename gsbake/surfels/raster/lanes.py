"""Eight float32 lanes as one value in Numba code: arithmetic, comparison, select, load and store, lowered to LLVM vectors.

LLVM's loop vectoriser has to prove that arrays do not overlap and gives up on loops with many accesses; here nothing is left to prove,
because every operation is written as one vector instruction. LLVM splits or joins them for the machine at hand (one AVX register, two
of SSE or NEON), so there is no code per machine.

`lanes(x)` copies a float32 to all lanes; `+ - *` and `/` work between lanes and with a float32; `<= < >=  >` give a `mask`, masks join
with `&`. Operations carry the flags of `FLAGS`: fused multiply-add is allowed, assuming away NaN is not.

Numba's file cache looks at the file of the compiled function only: whoever changes this file clears `__pycache__`.
"""

from __future__ import annotations

import math
import operator
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic as _intrinsic
from numba.extending import lower_builtin, models, register_model

intrinsic: Any = _intrinsic  # what it makes takes other arguments than Python sees
LANES = 8
FLAGS = ("nsz", "arcp", "contract", "afn", "reassoc")

#: 2^x on [−½, ½], constant term 1 so that 2^0 is exact; least relative error by reweighted least squares, 9.2e-8.
POWER = (1.0, 0.6931469775990563, 0.24022242085303536, 0.05550733743407135, 0.009671512642932367, 0.0013264727150590731)

_VECTOR = ir.VectorType(ir.FloatType(), LANES)
_BITS = ir.VectorType(ir.IntType(1), LANES)
_INTS = ir.VectorType(ir.IntType(32), LANES)


class _Lanes(types.Type):
    def __init__(self) -> None:
        super().__init__(name="lanes")


class _Mask(types.Type):
    def __init__(self) -> None:
        super().__init__(name="mask")


LANES_TYPE, MASK_TYPE = _Lanes(), _Mask()


@register_model(_Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)


@register_model(_Mask)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _BITS)


def _splat(builder: Any, value: Any) -> Any:
    """`value` in all lanes; vectors pass through."""
    if isinstance(value.type, ir.VectorType):
        return value
    one = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(one, ir.Constant(_VECTOR, ir.Undefined), ir.Constant(_INTS, [0] * LANES))


def _constant(values: Any) -> Any:
    return ir.Constant(_VECTOR, [float(v) for v in values])


def _binary(op: Any, result: Any, emit: Any, mixed: bool = True) -> None:
    """Teach Numba the operator `op` on lanes (and float32, when `mixed`)."""
    kinds = (LANES_TYPE, types.float32) if mixed else (MASK_TYPE,)

    @infer_global(op)
    class _Typed(AbstractTemplate):
        key = op

        def generic(self, args: Any, kws: Any) -> Any:
            if len(args) == 2 and (kinds[0] in args) and all(a in kinds for a in args):
                return signature(result, *args)
            return None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return emit(builder, *(_splat(builder, a) for a in args))

    for a in kinds:
        for b in kinds:
            if kinds[0] in (a, b):
                lower_builtin(op, a, b)(lower)


_binary(operator.add, LANES_TYPE, lambda b, x, y: b.fadd(x, y, flags=FLAGS))
_binary(operator.sub, LANES_TYPE, lambda b, x, y: b.fsub(x, y, flags=FLAGS))
_binary(operator.mul, LANES_TYPE, lambda b, x, y: b.fmul(x, y, flags=FLAGS))
_binary(operator.truediv, LANES_TYPE, lambda b, x, y: b.fdiv(x, y, flags=FLAGS))
_binary(operator.lt, MASK_TYPE, lambda b, x, y: b.fcmp_ordered("<", x, y))
_binary(operator.le, MASK_TYPE, lambda b, x, y: b.fcmp_ordered("<=", x, y))
_binary(operator.gt, MASK_TYPE, lambda b, x, y: b.fcmp_ordered(">", x, y))
_binary(operator.ge, MASK_TYPE, lambda b, x, y: b.fcmp_ordered(">=", x, y))
_binary(operator.and_, MASK_TYPE, lambda b, x, y: b.and_(x, y), mixed=False)


@intrinsic
def lanes(typing: Any, value: Any) -> Any:
    """A float32 in all lanes."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _splat(builder, args[0])

    return LANES_TYPE(types.float32), lower


def _ramp(values: Any) -> Any:
    @intrinsic
    def ramp(typing: Any) -> Any:
        def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            return _constant(values)

        return LANES_TYPE(), lower

    return ramp


#: Column and row of each lane in a block of 4 x 2 pixels.
BLOCK_X, BLOCK_Y = 4, 2
lane_column = _ramp([i % BLOCK_X for i in range(LANES)])
lane_row = _ramp([i // BLOCK_X for i in range(LANES)])


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, index: Any, kind: Any = _VECTOR) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), kind.as_pointer())


@intrinsic
def load(typing: Any, array: Any, index: Any) -> Any:
    """Lanes from eight consecutive float32 of a contiguous 1-D array, no bounds check."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_pointer(context, builder, sig.args[0], args[0], args[1]), align=4)

    return LANES_TYPE(array, types.uint64), lower


@intrinsic
def store(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """Write lanes to eight consecutive float32 of a contiguous 1-D array, no bounds check."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(args[2], _pointer(context, builder, sig.args[0], args[0], args[1]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.uint64, LANES_TYPE), lower


_HALF = ir.VectorType(ir.FloatType(), BLOCK_X)


def _part(builder: Any, value: Any, lanes_taken: Any) -> Any:
    kind = ir.VectorType(ir.IntType(32), len(lanes_taken))
    return builder.shuffle_vector(value, ir.Constant(value.type, ir.Undefined), ir.Constant(kind, lanes_taken))


@intrinsic
def load_block(typing: Any, array: Any, index: Any, stride: Any) -> Any:
    """Lanes from a block of 4 x 2 pixels of an image seen as a contiguous 1-D float32 array, no bounds check."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        at = [args[1], builder.add(args[1], args[2])]
        rows = [builder.load(_pointer(context, builder, sig.args[0], args[0], i, _HALF), align=4) for i in at]
        return builder.shuffle_vector(*rows, ir.Constant(_INTS, list(range(LANES))))

    return LANES_TYPE(array, types.uint64, types.uint64), lower


@intrinsic
def store_block(typing: Any, array: Any, index: Any, stride: Any, value: Any) -> Any:
    """Write lanes to a block of 4 x 2 pixels of an image seen as a contiguous 1-D float32 array, no bounds check."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        for row, at in enumerate((args[1], builder.add(args[1], args[2]))):
            half = _part(builder, args[3], list(range(row * BLOCK_X, (row + 1) * BLOCK_X)))
            builder.store(half, _pointer(context, builder, sig.args[0], args[0], at, _HALF), align=4)
        return context.get_dummy_value()

    return types.void(array, types.uint64, types.uint64, LANES_TYPE), lower


@intrinsic
def select(typing: Any, mask: Any, yes: Any, no: Any) -> Any:
    """`yes` where the mask is set, else `no` (each lanes or float32)."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(args[0], _splat(builder, args[1]), _splat(builder, args[2]))

    return LANES_TYPE(mask, yes, no), lower


@intrinsic
def some(typing: Any, mask: Any) -> Any:
    """Whether any lane of the mask is set."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))

    return types.boolean(mask), lower


@intrinsic
def total(typing: Any, value: Any) -> Any:
    """Sum of the lanes, as a tree."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = ir.FunctionType(ir.FloatType(), [ir.FloatType(), _VECTOR])
        reduce = cgutils.get_or_insert_function(builder.module, kind, f"llvm.vector.reduce.fadd.v{LANES}f32")
        return builder.call(reduce, [ir.Constant(ir.FloatType(), 0.0), args[0]], fastmath=FLAGS)

    return types.float32(value), lower


@intrinsic
def power_of_two(typing: Any, value: Any, one: Any, c1: Any, c2: Any, c3: Any, c4: Any, c5: Any) -> Any:
    """2^x of lanes −126 < x < 127 (other lanes hold rubbish) with the polynomial of `POWER`: x's whole part goes to the exponent bits."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        x, *constants = args
        rint = cgutils.get_or_insert_function(builder.module, ir.FunctionType(_VECTOR, [_VECTOR]), f"llvm.rint.v{LANES}f32")
        whole = builder.call(rint, [x])
        rest = builder.fsub(x, whole)
        result = constants[-1]
        for c in constants[-2::-1]:
            result = builder.fadd(builder.fmul(result, rest, flags=("contract",)), c, flags=("contract",))
        shift = builder.shl(builder.fptosi(whole, _INTS), ir.Constant(_INTS, [23] * LANES))
        return builder.bitcast(builder.add(builder.bitcast(result, _INTS), shift), _VECTOR)

    return LANES_TYPE(*[LANES_TYPE] * 7), lower


@intrinsic
def root(typing: Any, value: Any) -> Any:
    """Square root of lanes."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        sqrt = cgutils.get_or_insert_function(builder.module, ir.FunctionType(_VECTOR, [_VECTOR]), f"llvm.sqrt.v{LANES}f32")
        return builder.call(sqrt, [args[0]])

    return LANES_TYPE(LANES_TYPE), lower


#: Bits of √½: at this mantissa a float passes from one power of two to the next.
_HALF_ROOT = 0x3F3504F3


@intrinsic
def logarithm(typing: Any, value: Any) -> Any:
    """Natural logarithm of lanes that are positive and normal (other lanes hold rubbish), relative error below 3e-7.

    x = 2^e m with m in √½..√2, and ln m = 2 artanh s with s = (m − 1)/(m + 1): five terms of its series, the sixth is below 3e-9 of it.
    """

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], _INTS)
        shift = ir.Constant(_INTS, [23] * LANES)
        whole = builder.ashr(builder.sub(bits, ir.Constant(_INTS, [_HALF_ROOT] * LANES)), shift)
        m = builder.bitcast(builder.sub(bits, builder.shl(whole, shift)), _VECTOR)
        one = _constant([1.0] * LANES)
        s = builder.fdiv(builder.fsub(m, one), builder.fadd(m, one), flags=("contract",))
        square = builder.fmul(s, s)
        series = _constant([2 / 9] * LANES)
        for n in (7, 5, 3, 1):
            series = builder.fadd(builder.fmul(series, square, flags=("contract",)), _constant([2 / n] * LANES), flags=("contract",))
        powers = builder.fmul(builder.sitofp(whole, _VECTOR), _constant([math.log(2)] * LANES), flags=("contract",))
        return builder.fadd(powers, builder.fmul(s, series, flags=("contract",)), flags=("contract",))

    return LANES_TYPE(LANES_TYPE), lower


@intrinsic(prefer_literal=True)
def prefetch(typing: Any, array: Any, row: Any, write: Any) -> Any:
    """Ask for a row of a contiguous array to be brought to the cache (`write` is the literal 0 or 1); no bounds check, no fault."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        view = context.make_array(sig.args[0])(context, builder, args[0])
        step, number = cgutils.unpack_tuple(builder, view.strides)[0], ir.IntType(32)
        first = builder.mul(step, args[1])
        for at in (first, builder.add(first, builder.sub(step, ir.Constant(step.type, 4)))):  # a row may lie across two cache lines
            address = builder.gep(builder.bitcast(view.data, ir.IntType(8).as_pointer()), [at])
            kind = ir.FunctionType(ir.VoidType(), [address.type, number, number, number])
            call = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
            builder.call(call, [address, *(ir.Constant(number, v) for v in (write.literal_value, 3, 1))])
        return context.get_dummy_value()

    return types.void(array, types.uint64, write), lower

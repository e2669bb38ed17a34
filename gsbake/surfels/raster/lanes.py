"""Explicit SIMD for Numba: a type of eight float32 lanes with arithmetic, comparison, select, load and store, lowered to LLVM vectors.

LLVM's loop vectoriser must prove that arrays do not alias and gives up on loops with many accesses. Here every operation is a vector
instruction, so nothing has to be proved. LLVM legalises the vectors for the target (one AVX register, two of SSE or NEON).

`broadcast(x)` copies a float32 to all lanes. `+ - * /` take lanes and float32; `< <= > >=` return a mask; masks combine with `&`.
Operations carry `FASTMATH_FLAGS`: fused multiply-add is allowed, assuming that there is no NaN is not.

Numba's file cache checks only the file of the compiled function: clear `__pycache__` after a change to this file.
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

intrinsic: Any = _intrinsic  # an intrinsic is called with other arguments than its Python signature shows
#: Lanes of one vector.
LANES = 8
#: LLVM fast-math flags of every operation; no "nnan".
FASTMATH_FLAGS = ("nsz", "arcp", "contract", "afn", "reassoc")

#: Polynomial of 2^x on [−½, ½], lowest power first; constant term 1 so that 2^0 is exact. Reweighted least squares, relative error 9.2e-8.
EXP2_COEFFICIENTS = (1.0, 0.6931469775990563, 0.24022242085303536, 0.05550733743407135, 0.009671512642932367, 0.0013264727150590731)

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


def _broadcast(builder: Any, value: Any) -> Any:
    """`value` in all lanes; a vector is returned unchanged."""
    if isinstance(value.type, ir.VectorType):
        return value
    first = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(first, ir.Constant(_VECTOR, ir.Undefined), ir.Constant(_INTS, [0] * LANES))


def _constant(values: Any) -> Any:
    return ir.Constant(_VECTOR, [float(v) for v in values])


def _register_operator(op: Any, result: Any, emit: Any, mixed: bool = True) -> None:
    """Register the operator `op` on lanes and, when `mixed`, on lanes with float32; on masks otherwise."""
    operands = (LANES_TYPE, types.float32) if mixed else (MASK_TYPE,)

    @infer_global(op)
    class _Typed(AbstractTemplate):
        key = op

        def generic(self, args: Any, kws: Any) -> Any:
            if len(args) == 2 and (operands[0] in args) and all(a in operands for a in args):
                return signature(result, *args)
            return None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return emit(builder, *(_broadcast(builder, a) for a in args))

    for a in operands:
        for b in operands:
            if operands[0] in (a, b):
                lower_builtin(op, a, b)(lower)


_register_operator(operator.add, LANES_TYPE, lambda b, x, y: b.fadd(x, y, flags=FASTMATH_FLAGS))
_register_operator(operator.sub, LANES_TYPE, lambda b, x, y: b.fsub(x, y, flags=FASTMATH_FLAGS))
_register_operator(operator.mul, LANES_TYPE, lambda b, x, y: b.fmul(x, y, flags=FASTMATH_FLAGS))
_register_operator(operator.truediv, LANES_TYPE, lambda b, x, y: b.fdiv(x, y, flags=FASTMATH_FLAGS))
_register_operator(operator.lt, MASK_TYPE, lambda b, x, y: b.fcmp_ordered("<", x, y))
_register_operator(operator.le, MASK_TYPE, lambda b, x, y: b.fcmp_ordered("<=", x, y))
_register_operator(operator.gt, MASK_TYPE, lambda b, x, y: b.fcmp_ordered(">", x, y))
_register_operator(operator.ge, MASK_TYPE, lambda b, x, y: b.fcmp_ordered(">=", x, y))
_register_operator(operator.and_, MASK_TYPE, lambda b, x, y: b.and_(x, y), mixed=False)


@intrinsic
def broadcast(typing: Any, value: Any) -> Any:
    """Lanes that all hold one float32."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _broadcast(builder, args[0])

    return LANES_TYPE(types.float32), lower


def _constant_lanes(values: Any) -> Any:
    """Intrinsic without arguments that returns constant lanes."""

    @intrinsic
    def constant_lanes(typing: Any) -> Any:
        def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            return _constant(values)

        return LANES_TYPE(), lower

    return constant_lanes


#: Width and height in pixels of the block that one vector covers.
BLOCK_X, BLOCK_Y = 4, 2
#: Column and row of each lane in its block.
lane_column = _constant_lanes([i % BLOCK_X for i in range(LANES)])
lane_row = _constant_lanes([i // BLOCK_X for i in range(LANES)])


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, index: Any, kind: Any = _VECTOR) -> Any:
    """Pointer to `kind` at an element of an array."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), kind.as_pointer())


@intrinsic
def load(typing: Any, array: Any, index: Any) -> Any:
    """Lanes from eight consecutive float32 of a contiguous 1-D array; no bounds check."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_pointer(context, builder, sig.args[0], args[0], args[1]), align=4)

    return LANES_TYPE(array, types.uint64), lower


@intrinsic
def store(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """Write lanes to eight consecutive float32 of a contiguous 1-D array; no bounds check."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(args[2], _pointer(context, builder, sig.args[0], args[0], args[1]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.uint64, LANES_TYPE), lower


_ROW = ir.VectorType(ir.FloatType(), BLOCK_X)


def _extract(builder: Any, value: Any, indices: Any) -> Any:
    """Vector of the lanes at `indices`."""
    kind = ir.VectorType(ir.IntType(32), len(indices))
    return builder.shuffle_vector(value, ir.Constant(value.type, ir.Undefined), ir.Constant(kind, indices))


@intrinsic
def load_block(typing: Any, array: Any, index: Any, stride: Any) -> Any:
    """Lanes from a block of 4 x 2 pixels of an image stored as a contiguous 1-D float32 array; no bounds check."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        at = [args[1], builder.add(args[1], args[2])]
        rows = [builder.load(_pointer(context, builder, sig.args[0], args[0], i, _ROW), align=4) for i in at]
        return builder.shuffle_vector(*rows, ir.Constant(_INTS, list(range(LANES))))

    return LANES_TYPE(array, types.uint64, types.uint64), lower


@intrinsic
def store_block(typing: Any, array: Any, index: Any, stride: Any, value: Any) -> Any:
    """Write lanes to a block of 4 x 2 pixels of an image stored as a contiguous 1-D float32 array; no bounds check."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        for row, at in enumerate((args[1], builder.add(args[1], args[2]))):
            pixels = _extract(builder, args[3], list(range(row * BLOCK_X, (row + 1) * BLOCK_X)))
            builder.store(pixels, _pointer(context, builder, sig.args[0], args[0], at, _ROW), align=4)
        return context.get_dummy_value()

    return types.void(array, types.uint64, types.uint64, LANES_TYPE), lower


@intrinsic
def select(typing: Any, mask: Any, yes: Any, no: Any) -> Any:
    """`yes` where the mask is set, else `no` (each lanes or float32)."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(args[0], _broadcast(builder, args[1]), _broadcast(builder, args[2]))

    return LANES_TYPE(mask, yes, no), lower


@intrinsic
def any_lane(typing: Any, mask: Any) -> Any:
    """Whether any lane of the mask is set."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))

    return types.boolean(mask), lower


@intrinsic
def sum_lanes(typing: Any, value: Any) -> Any:
    """Sum of the lanes by tree reduction."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = ir.FunctionType(ir.FloatType(), [ir.FloatType(), _VECTOR])
        reduce = cgutils.get_or_insert_function(builder.module, kind, f"llvm.vector.reduce.fadd.v{LANES}f32")
        return builder.call(reduce, [ir.Constant(ir.FloatType(), 0.0), args[0]], fastmath=FASTMATH_FLAGS)

    return types.float32(value), lower


@intrinsic
def exp2(typing: Any, value: Any, one: Any, c1: Any, c2: Any, c3: Any, c4: Any, c5: Any) -> Any:
    """2^x of lanes −126 < x < 127, undefined elsewhere; `one`, `c1`…`c5` are the broadcast `EXP2_COEFFICIENTS`.

    The polynomial is evaluated on x − round(x); round(x) is added to the exponent bits.
    """

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
def sqrt(typing: Any, value: Any) -> Any:
    """Square root of lanes."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        sqrt = cgutils.get_or_insert_function(builder.module, ir.FunctionType(_VECTOR, [_VECTOR]), f"llvm.sqrt.v{LANES}f32")
        return builder.call(sqrt, [args[0]])

    return LANES_TYPE(LANES_TYPE), lower


#: Bit pattern of √½: subtracting it before the exponent is read puts the mantissa in √½..√2.
_SQRT_HALF_BITS = 0x3F3504F3


@intrinsic
def log(typing: Any, value: Any) -> Any:
    """Natural logarithm of positive normal lanes, undefined elsewhere; relative error below 3e-7.

    x = 2^e m with m in √½..√2, and ln m = 2 artanh s with s = (m − 1)/(m + 1): five terms of the series; the sixth is below 3e-9 of it.
    """

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], _INTS)
        shift = ir.Constant(_INTS, [23] * LANES)
        exponent = builder.ashr(builder.sub(bits, ir.Constant(_INTS, [_SQRT_HALF_BITS] * LANES)), shift)
        m = builder.bitcast(builder.sub(bits, builder.shl(exponent, shift)), _VECTOR)
        one = _constant([1.0] * LANES)
        s = builder.fdiv(builder.fsub(m, one), builder.fadd(m, one), flags=("contract",))
        square = builder.fmul(s, s)
        series = _constant([2 / 9] * LANES)
        for n in (7, 5, 3, 1):
            series = builder.fadd(builder.fmul(series, square, flags=("contract",)), _constant([2 / n] * LANES), flags=("contract",))
        scaled = builder.fmul(builder.sitofp(exponent, _VECTOR), _constant([math.log(2)] * LANES), flags=("contract",))
        return builder.fadd(scaled, builder.fmul(s, series, flags=("contract",)), flags=("contract",))

    return LANES_TYPE(LANES_TYPE), lower


@intrinsic(prefer_literal=True)
def prefetch(typing: Any, array: Any, row: Any, write: Any) -> Any:
    """Prefetch a row of a contiguous array, for writing when the literal `write` is 1 and for reading when 0; no bounds check, no fault."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        view = context.make_array(sig.args[0])(context, builder, args[0])
        stride, number = cgutils.unpack_tuple(builder, view.strides)[0], ir.IntType(32)
        first = builder.mul(stride, args[1])
        for at in (first, builder.add(first, builder.sub(stride, ir.Constant(stride.type, 4)))):  # a row may span two cache lines
            address = builder.gep(builder.bitcast(view.data, ir.IntType(8).as_pointer()), [at])
            kind = ir.FunctionType(ir.VoidType(), [address.type, number, number, number])
            call = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
            builder.call(call, [address, *(ir.Constant(number, v) for v in (write.literal_value, 3, 1))])
        return context.get_dummy_value()

    return types.void(array, types.uint64, write), lower

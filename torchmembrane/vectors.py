"""Vectors of consecutive numbers in machine code: an operation computes as many numbers as a register of the processor holds.

`load` reads a vector from an array, `spread` fills one with a single number, `store` writes it, and `total` sums its numbers.
Between these, `+`, `-`, `*` and `/` compute with vectors, and with numbers, which stand for vectors of equal numbers. Without
this, numba uses the processor's vectors only for simple loops.
"""

import operator
from typing import Any

from llvmlite import binding, ir
from numba import types
from numba.core import cgutils, config
from numba.core.datamodel import models
from numba.extending import intrinsic, overload, register_model


def _bytes() -> int:
    """Return the size of a vector: that of a register with AVX-512, else that of one with AVX2; other processors use two."""
    features = binding.get_host_cpu_features().flatten() if config.CPU_FEATURES is None else config.CPU_FEATURES
    return 64 if "+avx512f" in features.split(",") else 32


BYTES = _bytes()
"""Size of a vector in bytes."""


class Vector(types.Type):
    """The type of vectors of numbers of a type."""

    def __init__(self, dtype: Any):
        self.dtype = dtype
        super().__init__(name=f"Vector({dtype})")

    @property
    def lanes(self) -> int:
        """Return how many numbers a vector holds."""
        return BYTES * 8 // int(self.dtype.bitwidth)


@register_model(Vector)
class VectorModel(models.PrimitiveModel):
    """A vector in machine code."""

    def __init__(self, manager: Any, kind: Any):
        number = manager.lookup(kind.dtype).get_value_type()
        super().__init__(manager, kind, ir.VectorType(number, kind.lanes))


def _place(context: Any, builder: Any, kind: Any, array: Any, at: Any) -> Any:
    """Return a pointer to a number of an array."""
    return builder.gep(context.make_array(kind)(context, builder, array).data, [at])


@intrinsic
def load(typing: Any, array: Any, at: Any) -> Any:
    """Return the vector of the numbers from place `at` on of a contiguous array; places count through all its dimensions."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        place, vector = _place(context, builder, array, *args), context.get_value_type(signature.return_type)
        value = builder.load(builder.bitcast(place, vector.as_pointer()))
        value.align = array.dtype.bitwidth // 8
        return value

    return Vector(array.dtype)(array, types.intp), codegen


@intrinsic
def spread(typing: Any, array: Any, at: Any) -> Any:
    """Return a vector that is filled with the number at place `at` of a contiguous array."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        number = builder.load(_place(context, builder, array, *args))
        return _spread(context, builder, signature.return_type, array.dtype, number)

    return Vector(array.dtype)(array, types.intp), codegen


@intrinsic
def store(typing: Any, array: Any, at: Any, value: Any) -> Any:
    """Write a vector to the places from `at` on of a contiguous array."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        place = builder.bitcast(_place(context, builder, array, *args[:2]), args[2].type.as_pointer())
        builder.store(args[2], place).align = array.dtype.bitwidth // 8
        return context.get_dummy_value()

    return types.void(array, types.intp, value), codegen


@intrinsic
def total(typing: Any, value: Any) -> Any:
    """Return the sum of a vector's numbers, in any order."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        whole, number = args[0].type, args[0].type.element
        name = f"llvm.vector.reduce.fadd.v{whole.count}{number.intrinsic_name}"
        add = cgutils.get_or_insert_function(builder.module, ir.FunctionType(number, [number, whole]), name)
        return builder.call(add, [ir.Constant(number, 0.0), args[0]], fastmath=("reassoc",))

    return value.dtype(value), codegen


def _define(operation: Any, instruction: str) -> None:
    """Define an operation for two vectors, and for a vector and a number."""

    @intrinsic
    def compute(typing: Any, a: Any, b: Any) -> Any:
        vector = a if isinstance(a, Vector) else b

        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            both = [_spread(context, builder, vector, *each) for each in zip(signature.args, args, strict=True)]
            flags = () if instruction == "fdiv" else ("contract",)
            return getattr(builder, instruction)(*both, flags=flags)

        return vector(a, b), codegen

    @overload(operation, strict=False)
    def of_vectors(a: Any, b: Any) -> Any:
        if isinstance(a, Vector) or isinstance(b, Vector):
            return lambda a, b: compute(a, b)
        return None


def _spread(context: Any, builder: Any, vector: Vector, kind: Any, value: Any) -> Any:
    """Return a value if it is a vector, else a vector of this number."""
    if isinstance(kind, Vector):
        return value
    number, whole = context.cast(builder, value, kind, vector.dtype), context.get_value_type(vector)
    index, empty = ir.IntType(32), ir.Constant(whole, ir.Undefined)
    one = builder.insert_element(empty, number, ir.Constant(index, 0))
    return builder.shuffle_vector(one, empty, ir.Constant(ir.VectorType(index, vector.lanes), [0] * vector.lanes))


for _operation, _instruction in {"add": "fadd", "sub": "fsub", "mul": "fmul", "truediv": "fdiv"}.items():
    _define(getattr(operator, _operation), _instruction)

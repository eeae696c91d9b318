"""A compiler for functions of a candidate: every number of the traced function becomes a vector with a lane for each.

XLA runs such a function array by array, which keeps the numbers of all candidates in memory between two operations.
Here a block of candidates goes through the whole function in registers. `trace` turns the function's jaxpr into single
numbers, a `graph`, `emit` writes them as LLVM code, `compiled` has it compiled, keeps it and calls it from XLA's
programs.
"""

"""Compiled inner loops on a CPU, one module for each that has a plain torch reference.

Nothing here decides anything: the modules of the same names outside hold the reference and say what
is computed; ``fused`` modules beside them hand tensors over. A kernel takes the slice of the batch
that it works on, and writes into arrays that it is given (see `torchptz.compiled.run`).

Why this is fast: an item's points fit the first cache of a core, and every step of its solution is
done before the next item is touched, where batched tensor operations send each intermediate of the
whole batch through memory. What bounds it is arithmetic: see the modules.
"""

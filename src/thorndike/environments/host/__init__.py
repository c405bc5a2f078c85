"""Host engines: environments stepped from Python or C++, outside the compiled program.

A host engine is a small object: ``spec``, ``reset(seeds) -> obs``, ``step(actions) -> Step`` of NumPy arrays, and ``close()``. Every array
it returns is fresh: JAX may alias NumPy memory on the CPU, so a buffer is never written to again.
"""

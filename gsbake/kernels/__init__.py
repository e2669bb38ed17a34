"""Compiled kernels: how they are declared, and their compilation in processes of its own."""

# For mypy alone: gsbake.stages is the folder stages/, which is checked under that name. Without an __init__ beside it, this file adds
# a module to the package gsbake and hides none.
from stages import ORDER as ORDER
from stages import REGISTRY as REGISTRY

"""Expression graphs of the package's own formulas: traced from array code, evaluated on arrays or compiled from C."""

from .c_functions import (
    format_number as format_number,
    yield_function as yield_function,
    yield_graph_lines as yield_graph_lines,
    yield_guard_lines as yield_guard_lines,
    yield_output_lines as yield_output_lines,
    yield_unused_lines as yield_unused_lines,
)
from .compiler import (
    LibraryCache as LibraryCache,
    compile_library as compile_library,
    find_compiler as find_compiler,
    is_compiling_allowed as is_compiling_allowed,
)
from .graph import (
    Graph as Graph,
    Node as Node,
    evaluate_graph as evaluate_graph,
)
from .tape import Tape as Tape, find_tape as find_tape
from .tracing import (
    ExpressionArray as ExpressionArray,
    TracedFunction as TracedFunction,
    as_expression_array as as_expression_array,
    build_inputs as build_inputs,
    flatten_outputs as flatten_outputs,
    trace_function as trace_function,
)

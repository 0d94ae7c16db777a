"""A CasADi expression in sympy's hands: the same operations, one by one, on sympy's symbols."""

import casadi as ca
import sympy as sp

_BINARY = {
    ca.OP_ADD: lambda a, b: a + b,
    ca.OP_SUB: lambda a, b: a - b,
    ca.OP_MUL: lambda a, b: a * b,
    ca.OP_DIV: lambda a, b: a / b,
}
_UNARY = {
    ca.OP_NEG: lambda a: -a,
    ca.OP_SQ: lambda a: a**2,
    ca.OP_TWICE: lambda a: 2 * a,
    ca.OP_INV: lambda a: 1 / a,
    ca.OP_SIN: sp.sin,
    ca.OP_COS: sp.cos,
    ca.OP_SQRT: sp.sqrt,
    ca.OP_ASSIGN: lambda a: a,
}


def in_sympy(expression: ca.SX, symbols: dict[str, ca.SX]) -> tuple[sp.Matrix, dict[str, sp.Expr]]:
    """The expression as a matrix, and the symbols that stand in it by name.

    Constants become the nearest rationals with small denominators: 0.5 is a half.
    """
    function = ca.Function("f", list(symbols.values()), [ca.densify(expression)])
    own = {name: sp.Symbol(name, real=True) for name in symbols}
    arguments = list(own.values())
    work: dict[int, sp.Expr] = {}
    rows, columns = expression.shape
    result = sp.zeros(rows, columns)
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        into, given = function.instruction_output(k), function.instruction_input(k)
        if operation == ca.OP_INPUT:
            work[into[0]] = arguments[given[0]]
        elif operation == ca.OP_OUTPUT:
            result[into[1] % rows, into[1] // rows] = work[given[0]]
        elif operation == ca.OP_CONST:
            constant = function.instruction_constant(k)
            work[into[0]] = sp.nsimplify(constant, rational=True).limit_denominator(1000)
        elif operation in _BINARY:
            work[into[0]] = _BINARY[operation](work[given[0]], work[given[1]])
        else:
            work[into[0]] = _UNARY[operation](work[given[0]])
    return result, own

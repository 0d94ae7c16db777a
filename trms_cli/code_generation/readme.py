"""The README of an exported controller."""

from __future__ import annotations

from typing import TYPE_CHECKING

from trms_cli.code_generation.measure import Measured

if TYPE_CHECKING:
    from trms_cli.code_generation.export import Export


def readme(export: Export, command: str, measured: Measured | None) -> str:
    """Markdown: what it is, how to call it, signals, memory and times."""
    name = export.name
    sections = [
        f"# {name}: a Newton MPC in C\n",
        f"Made by\n\n    {command}\n",
        "C99 without any library but `libm` (and `memcpy`, `memset` of the C library), without "
        "`malloc` and without recursion. All that changes is in a struct of the caller.\n",
        _files(name),
        _call(export),
        _signals(export),
        _settings(name),
        _guarantees(name),
        _figures(export, measured),
        "## Licences\n\n"
        f"`{name}.c` contains an extract of DAQP (MIT, © 2022 Daniel Arnström, its text is in the "
        "source) and helpers that CasADi generates (MIT-0).\n",
    ]
    return "\n".join(sections)


def _files(name: str) -> str:
    return f"""\
| file | what it is |
|---|---|
| `{name}.c`, `{name}.h` | the controller: these two go to the rig |
| `{name}_example.c` | drives it through a table of samples, compares, takes times |
| `example.csv` | samples of a simulated loop with the commands of the Python controller |
| `Makefile` | `make check` builds and runs the example |
| `controller.json` | the figures of this page for programs |
"""


def _call(export: Export) -> str:
    name, upper = export.name, export.name.upper()
    if export.observer is None:
        return f"""\
## Calling it

```c
static {name}_ctx controller;           /* zero-cost to place: static, or any memory */
{name}_init(&controller);               /* or {name}_init_at(&controller, u_in_force) */
for (;;) {{                              /* every {upper}_PERIOD = {export.source.period:g} s */
    {name}_info info;
    {name}_step(&controller, x_hat, w_hat, reference, u_previous, u, &info);
    /* apply u; u_previous is what was applied, after any limit of the drive */
}}
```
"""
    period = export.observer.period
    ratio = round(export.source.period / period)
    return f"""\
## Calling it

```c
static {name}_ctx controller;
static {name}_observer observer;
double x_hat[{upper}_N_X], w_hat[{upper}_N_W], u[{upper}_N_U] = {{0}};
{name}_init(&controller);
{name}_observer_init(&observer, y, u);  /* y: the first measurement */
for (k = 0;; k++) {{                     /* every {upper}_OBSERVER_PERIOD = {period:g} s */
    /* read y; NaN, or 0 in a mask, where a sample is missing */
    {name}_observe(&observer, u, y, NULL, x_hat, w_hat);
    if (k % {ratio} == 0)
        {name}_step(&controller, x_hat, w_hat, reference, u, u, &info);
    /* apply u, and write back into it what the drive made of it */
}}
```
"""


def _signals(export: Export) -> str:
    model, upper = export.setup.model, export.name.upper()
    preview = export.controller.preview(export.setup)
    lines = ["## Signals\n", "| argument | position | signal | unit |", "|---|---|---|---|"]
    groups = {
        "x_hat": [(s.name, s.unit, s.description) for s in model.states],
        "w_hat": [(s.name, s.unit, s.description) for s in model.disturbances],
        "u, u_previous": [(s.name, s.unit, s.description) for s in model.inputs],
    }
    if export.observer is not None:
        outputs = {s.name: s for s in model.outputs}
        groups["y"] = [
            (name, outputs[name].unit, outputs[name].description)
            for name in export.observer.channels
        ]
    for argument, signals in groups.items():
        for i, (name, unit, description) in enumerate(signals):
            words = f"{name}: {description}" if description else name
            lines.append(f"| `{argument}` | {i} | {words} | {unit} |")
    followed = ", ".join(model.controlled)
    lower, upper_bound = model.input_bounds()
    limits = ", ".join(
        f"{s.name} {a:g} … {b:g} {s.unit}"
        for s, a, b in zip(model.inputs, lower.tolist(), upper_bound.tolist(), strict=True)
    )
    lines.append(
        f"\n`reference[k * {upper}_N_R + i]`: {followed} (i), k = 0 … {preview} control periods "
        f"ahead. Limits of the commands: {limits}.\n"
    )
    return "\n".join(lines)


def _settings(name: str) -> str:
    return f"""\
## Changing it

Parameters, weights, limits, prices, tolerance and iterations stand in `controller.settings`
(`{name}_settings` in the header, with units) and may be changed between two steps. What has a
size (horizon, blocks, which states have weights or limits, preview) and the sample time are
fixed: export again. The typical sizes of states that scale the terminal constraint are not
computed anew from changed parameters.
"""


def _guarantees(name: str) -> str:
    return f"""\
## What holds in every step

- `u` is finite and within the limits, whatever the arguments are; a step without a usable solution
  returns `FAILED` and says in `info.fallback` what acted.
- Newton iterations, changes of the active set and iterations of the search for the steady state
  are bounded. The search is the least even part: a reference that is out of reach, or a torque
  that cannot be held, costs several hundred of its iterations in that one step
  (`info.steady_iterations`).
- Two contexts never share anything: `{name}_step` may run in several threads on several contexts.
- A quadratic program whose Hessian is too ill-conditioned (about 1e13; DAQP in Python regularises
  it) counts as failed.
"""


def _figures(export: Export, measured: Measured | None) -> str:
    sizes = export.source.sizes
    what = (
        f"{sizes['N']} control periods, {sizes['N_Z']} unknowns, {sizes['ROWS']} rows"
        + (f" and {sizes['ROWS_SOFT']} of soft limits" if sizes["ROWS_SOFT"] else "")
        + f", at most {export.controller.max_iterations} iterations"
    )
    if measured is None:
        return (
            f"## Memory and time\n\n{what}. Not measured here: `make check` and `make size` do.\n"
        )
    rows = [
        ("step, median", f"{measured.median:.1f} µs"),
        ("step, 99 %", f"{measured.p99:.1f} µs"),
        ("step, slowest sample in the best of five passes", f"{measured.slowest:.1f} µs"),
        ("step, longest of all", f"{measured.longest:.1f} µs"),
        *(
            [
                ("observer, median", f"{measured.observer_median:.1f} µs"),
                ("observer, 99 %", f"{measured.observer_p99:.1f} µs"),
                ("observer, longest", f"{measured.observer_longest:.1f} µs"),
            ]
            if measured.observer_median is not None
            else []
        ),
        ("largest difference to the Python controller", f"{measured.largest_difference:.2g} V"),
        ("context (`sizeof`)", _bytes(measured.context_bytes)),
    ]
    if measured.observer_bytes:
        rows.append(("observer (`sizeof`)", _bytes(measured.observer_bytes)))
    if measured.code_bytes is not None:
        rows.append(("code and constants", _bytes(measured.code_bytes)))
    if measured.data_bytes is not None:
        rows.append(("`.data` and `.bss`", _bytes(measured.data_bytes)))
    if measured.stack_bytes is not None:
        rows.append(("stack, at the most (all frames together)", _bytes(measured.stack_bytes)))
    table = "\n".join(f"| {key} | {value} |" for key, value in rows)
    return f"""\
## Memory and time

{what}. {measured.samples} steps of `example.csv` on {measured.processor}, {measured.compiler},
`-std=c99 -O3`; the machine's other work is in
the longest times.

| | |
|---|---|
{table}
"""


def _bytes(count: int) -> str:
    return f"{count} bytes" if count < 10_000 else f"{count / 1024:.0f} KiB"

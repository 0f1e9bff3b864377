# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl acquire`: plan, run, resume, finalize and report of an acquisition, which is a folder."""

from __future__ import annotations

import typer

from ltcl.cli import acquire_finalize, acquire_plan, acquire_report, acquire_run

app = typer.Typer(
    help="Photograph a scene under patterns, and make its transport of the photographs.\n\n"
    "DIR is a folder with an acquisition.toml, which says what photographs, and how; 'ltcl simulate' makes "
    "one. The transport comes to DIR/transport.zarr.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
)
app.command("plan")(acquire_plan.run)
app.command("run")(acquire_run.run)
app.command("resume")(acquire_run.resume)
app.command("finalize")(acquire_finalize.run)
app.command("report")(acquire_report.run)

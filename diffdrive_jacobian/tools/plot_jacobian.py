"""Draw a picture of the documents."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from diffdrive_jacobian import plots
from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.plots.output_files import FORMATS, create, extension, new_file
from diffdrive_jacobian.plots.rendering import render, styled
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import _cli, _output
from diffdrive_jacobian.tools.entry_points import DONE

PROGRAM = 'plot_jacobian'


def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool; return the exit code."""
    options = _parser().parse(arguments, ros=False)
    output = f'{options.name}.png' if options.output is None else options.output
    try:
        path = new_file(output, FORMATS, 'picture', replace=options.force)
        with (
            _output.explaining_no_matplotlib(),
            _output.busy(PROGRAM, 'drawing'),
            signals.ending_at_once(),
            styled(),
        ):
            content = render(getattr(plots, options.name)(), extension(path))
        if signals.count:
            return _output.interrupted(PROGRAM, 'nothing was written')
        create(path, content, replace=options.force)
    except (ValueError, UserError, FileExistsError) as error:
        return _output.complain(PROGRAM, error)
    except OSError as error:
        return _output.cannot_write(PROGRAM, output, error)
    print(path)
    return DONE


def _name(text: str) -> str:
    """Parse the name of a picture."""
    if text not in plots.PICTURES:
        raise argparse.ArgumentTypeError(f'must be one of {", ".join(plots.PICTURES)}, got {text!r}')
    return text


def _parser() -> _cli.Parser:
    width = max(map(len, plots.PICTURES))
    pictures = '\n'.join(f'  {name:{width}}  {what}' for name, what in plots.PICTURES.items())
    parser = _cli.Parser(
        prog=PROGRAM,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Draw a picture of the documents, to scale and computed by the library:\n\n'
        f'{pictures}\n\n'
        'An existing file is not overwritten without --force. Exit code 0: drawn; 1: the file cannot\n'
        'be written; 2: wrong arguments, or no matplotlib; 130: interrupted.',
    )
    parser.add_argument('name', metavar='NAME', type=_name, help='the picture, one of those above')
    parser.add_output('FILE', f'file to write, .{", .".join(FORMATS)} (default: NAME.png)')
    parser.add_force('the file')
    return parser

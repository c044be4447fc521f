"""`fibaction export`: write a recording as an MCAP file, by
`fibaction.observe.recordings.mcap_export`.
"""

from __future__ import annotations

import click

from fibaction.cli.output.lines import say
from fibaction.cli.process.exit_codes import ExitCode, Failure


@click.command("export", epilog="\b\nExample:\n  fibaction export today.jsonl today.mcap")
@click.argument("recording", metavar="FILE", type=click.Path(exists=True, dir_okay=False))
@click.argument("path", metavar="MCAP_FILE", type=click.Path(dir_okay=False))
def export_command(recording: str, path: str) -> None:
    """Write a recording as an MCAP file, which Foxglove opens. MCAP_FILE is replaced."""
    from fibaction.observe.recordings.mcap_export import export_mcap
    from fibaction.observe.recordings.recording_file import RecordingError

    try:
        count = export_mcap(recording, path)
    except (ImportError, RecordingError) as exc:
        raise Failure(str(exc), ExitCode.USAGE) from exc
    except OSError as exc:
        raise Failure(f"cannot write {path}: {exc.strerror}", ExitCode.USAGE) from exc
    say(f"{path} has {count:,} messages")

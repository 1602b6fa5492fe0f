"""The entry point of `optshape`: from here on a signal ends it in one line, before anything heavy is imported."""

from optshape_graph.runs.interruption import end_on_signals


def main() -> None:
    """Run the command line."""
    end_on_signals()
    from optshape_graph.cli.main import main

    main()

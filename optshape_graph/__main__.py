"""`python -m optshape_graph` is `optshape`."""

from optshape_graph.cli.entry import main

if __name__ == "__main__":
    main()

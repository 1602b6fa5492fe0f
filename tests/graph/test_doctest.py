import doctest

from optshape_graph import graph


def test_the_example_in_the_docstring_runs():
    results = doctest.testmod(graph)
    assert results.attempted > 10
    assert results.failed == 0

"""Motion capture: each vendor's files become one `MocapRecording`, in metres and seconds.

One module for each vendor or format; `files` chooses among them.
"""

from optshape_graph.io.mocap.c3d import read_c3d
from optshape_graph.io.mocap.files import form_of, read_mocap
from optshape_graph.io.mocap.motive import read_motive_bodies, read_motive_csv
from optshape_graph.io.mocap.qualisys import read_qualisys_mat, read_qualisys_tsv
from optshape_graph.io.mocap.recording import UNLABELLED, MocapRecording
from optshape_graph.io.mocap.trc import read_trc
from optshape_graph.io.mocap.units import METRES
from optshape_graph.io.mocap.vicon import read_vicon_csv

__all__ = [
    "METRES",
    "UNLABELLED",
    "MocapRecording",
    "form_of",
    "read_c3d",
    "read_mocap",
    "read_motive_bodies",
    "read_motive_csv",
    "read_qualisys_mat",
    "read_qualisys_tsv",
    "read_trc",
    "read_vicon_csv",
]

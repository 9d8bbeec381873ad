"""The published figures: Kruzhkov et al., *MeSLAM*, SMC 2022, Tables I and II."""

from __future__ import annotations

from evaluated_recordings import tum_name

# The paper's sequences, and what TUM calls each after `freiburgN_`.
SEQUENCES = {"fr1/desk": "desk", "fr2/xyz": "xyz", "fr3/office": "long_office_household"}
# ATE RMSE [cm] on them.
ATE_CM = {
    "iMAP": (4.9, 2.0, 5.8),
    "iMAP*": (14.8, 7.78, 11.5),
    "MeSLAM": (6.0, 6.54, 7.5),
    "ORB-SLAM2": (1.6, 0.4, 1.0),
    "NICE-SLAM": (2.7, 1.8, 3.0),
    "Kintinuous": (3.7, 2.9, 3.0),
}
# Seconds of the same 57 m^3, and the map [MB] after them.
MAP_SECONDS = (30, 60, 90, 120, 150)
MAP_MB = {
    "KinectFusion": (70.1, 98.9, 158.2, 276.7, 436.6),
    "ElasticFusion": (17.5, 29.0, 38.2, 53.5, 63.6),
    "RTAB-Map": (8.7, 17.0, 25.1, 33.1, 37.9),
    "BAD SLAM": (13.1, 50.0, 86.4, 109.1, 123.8),
    "ORB-SLAM2": (18.9, 21.9, 30.4, 34.4, 38.8),
    "MeSLAM": (1.9, 1.9, 1.9, 1.9, 1.9),
}


def sequence_of(recording: str) -> str:
    """The paper's name of a sequence, whatever its folder is called exactly; empty for none."""
    for name, folder in SEQUENCES.items():
        if tum_name(recording) in (name, f"{name.split('/')[0]}/{folder}"):
            return name
    return ""

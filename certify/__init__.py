"""Proofs of contraction for recurrent networks. See docs/certification.md for what a verdict rests on."""

import sys

from certify.aliases import Moved

_ROOMS = {  # room -> its modules that were documented as modules of `certify`
    "proofs": ("certificate", "equilibria", "exact", "steps", "vector_certificate", "vector_exact"),
    "search": ("box", "lmi", "vector_lmi", "vector_scaling"),
    "training": ("conditions", "projections"),
    "command": ("compare",),
}
sys.meta_path.append(
    Moved(
        {f"certify.{name}": f"certify.{room}.{name}" for room, names in _ROOMS.items() for name in names}
        | {"certify.weights": "certify.networks.shallow", "certify.vector_weights": "certify.networks.vector"}
    )
)

"""A model back in the files of other programs: URDF, SDF, MJCF, FMU, and drives for BAM, mjlab and Isaac Lab."""

from .content import (
    Exported as Exported,
    compute_held_out_errors as compute_held_out_errors,
    describe_price as describe_price,
)
from .drive_files import build_drive_files as build_drive_files
from .fmu import ExportedFmu as ExportedFmu, build_fmu as build_fmu
from .mjcf import build_mjcf as build_mjcf
from .randomisation import (
    RandomisationFiles as RandomisationFiles,
    build_randomisation as build_randomisation,
    read_samples as read_samples,
)
from .sdf import build_sdf as build_sdf
from .urdf import build_urdf as build_urdf

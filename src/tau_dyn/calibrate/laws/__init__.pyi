"""What joints, drives and carts do beside moving as their encoders say."""

from .displaced_geometry import DisplacedGeometry as DisplacedGeometry, MovedJoints as MovedJoints
from .elastic_drives import (
    ElasticDrives as ElasticDrives,
    JointLoading as JointLoading,
    StaticForces as StaticForces,
)
from .joint_laws import (
    CartComplianceLaw as CartComplianceLaw,
    CouplingLaw as CouplingLaw,
    Displaced as Displaced,
    EccentricityLaw as EccentricityLaw,
    EncoderLaws as EncoderLaws,
    GuideBendLaw as GuideBendLaw,
    Law as Law,
    PeriodicDriveLaw as PeriodicDriveLaw,
    RodPathLaw as RodPathLaw,
    displace as displace,
    find_carried_rods as find_carried_rods,
    find_guideways as find_guideways,
)
from .rod_loads import RodLoads as RodLoads

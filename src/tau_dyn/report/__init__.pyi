"""Results -> tables, figures, one page; reads results, computes nothing new."""

from .accuracy_page import build_accuracy_page as build_accuracy_page
from .accuracy_terminal import print_accuracy as print_accuracy
from .calibration_page import build_calibration_page as build_calibration_page
from .calibration_terminal import print_calibration as print_calibration
from .check_terminal import print_check as print_check
from .comparison import build_comparison_page as build_comparison_page, print_comparison as print_comparison
from .diagnosis_page import build_diagnosis_page as build_diagnosis_page
from .diagnosis_terminal import print_diagnosis as print_diagnosis
from .identification_page import build_identification_page as build_identification_page
from .identification_terminal import print_identification as print_identification
from .kinematics_page import build_kinematics_page as build_kinematics_page, print_poses as print_poses
from .log_check_page import check_page as check_page
from .modes_page import build_modes_page as build_modes_page
from .modes_terminal import print_modes as print_modes, print_operational_modes as print_operational_modes
from .motion_pages import build_excitation_page as build_excitation_page, build_simulation_page as build_simulation_page
from .motion_plan_page import build_motion_plan_page as build_motion_plan_page
from .motion_plan_terminal import print_motion_plan as print_motion_plan
from .operational_page import build_operational_modes_page as build_operational_modes_page
from .poses_terminal import print_pose_plan as print_pose_plan
from .terminal import say as say
from .workspace_page import build_workspace_page as build_workspace_page
from .workspace_terminal import print_workspace as print_workspace
from .write import write_report as write_report

from .calibrate import calibrate as calibrate
from .control import Feedforward as Feedforward
from .effects import list_causes as list_causes
from .exceptions import CannotAnswer as CannotAnswer, InputError as InputError, TauDynError as TauDynError
from .identify import Choices as Choices, build_regression as build_regression, compare_fit as compare_fit
from .log import Log as Log, check_log as check_log, read_log as read_log
from .measured_data import fetch_data as fetch_data
from .mechanism import (
    build_mechanism as build_mechanism,
    forward_kinematics as forward_kinematics,
    inverse_kinematics as inverse_kinematics,
)
from .model import Model as Model
from .modes import find_modes as find_modes
from .render import write_report as write_report
from .robot import list_robots as list_robots, load_robot as load_robot
from .simulate import simulate as simulate
from .version import __version__ as __version__

# isort: split
# last, or the packages of these names hide the functions from a type checker
from .by_measurement import diagnose as diagnose, identify as identify

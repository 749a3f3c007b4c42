"""Results -> terminal, page, notebook, JSON; reads results, computes nothing new."""

from .camera_picture import draw_camera_picture as draw_camera_picture
from .kinds import ExcitingMotion as ExcitingMotion, SimulatedLog as SimulatedLog
from .notebook import render_notebook as render_notebook, tabulate as tabulate
from .page import build_page as build_page, write_report as write_report
from .presentation import present as present
from .terminal import print_result as print_result, say as say, summarise as summarise

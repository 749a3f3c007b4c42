"""The former name of `render`, where `build_page` and `print_result` take any result."""

from .former import (
    build_excitation_page as build_excitation_page,
    build_simulation_page as build_simulation_page,
    check_page as check_page,
    print_check as print_check,
)

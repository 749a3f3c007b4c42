"""Public measured logs: which there are, and one of them in a folder with its robot file, its column map and the next command."""

from .fetch import (
    DataFile as DataFile,
    DataSet as DataSet,
    FetchedData as FetchedData,
    fetch_data as fetch_data,
    find_set as find_set,
    list_sets as list_sets,
)

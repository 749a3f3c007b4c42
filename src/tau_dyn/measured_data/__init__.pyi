"""Public measured logs: which there are, and one of them in a folder with its robot file, its column map and the next command."""

from .catalogue import DataFile as DataFile, DataSet as DataSet, find_set as find_set, list_sets as list_sets
from .fetch import FetchedData as FetchedData, fetch_data as fetch_data

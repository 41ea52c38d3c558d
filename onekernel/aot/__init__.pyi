from .program_cache import ProgramCache as ProgramCache
from .program_cache import cache_folder as cache_folder
from .xla_options import known_options as known_options

from .clock import process_seconds as process_seconds
from .clock import restart_clock as restart_clock
from .progress import Advance as Advance
from .progress import in_foreground as in_foreground
from .progress import is_watched as is_watched
from .progress import show_progress as show_progress
from .progress import stage as stage
from .tables import text_table as text_table

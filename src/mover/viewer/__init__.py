"""Look at a room in the browser, correct it, and solve it again (extra `viewer`)."""

from .live import Watch as Watch
from .panel_solve import SolveJob as SolveJob
from .panel_solve import begin_watching as begin_watching
from .panel_solve import end_watching as end_watching
from .result import Shown as Shown
from .result import read_shown as read_shown
from .result import shown_before as shown_before
from .result import source_of as source_of
from .serve import Address as Address
from .serve import Opened as Opened
from .serve import open_viewer as open_viewer
from .session import Session as Session
from .session import start_session as start_session
from .solve import started_from as started_from

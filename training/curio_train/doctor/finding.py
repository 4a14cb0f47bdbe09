"""What an examination says: one thing looked at, what was found, how sure that is, and what to do."""

from dataclasses import dataclass
from typing import Literal

State = Literal["good", "warning", "bad"]
Sureness = Literal["certain", "likely", "possible"]


@dataclass(frozen=True)
class Finding:
    """One thing looked at."""

    subject: str
    """What was looked at."""
    state: State
    """Good; warning: works, but worse than it could; bad: will not work."""
    text: str
    """What was found."""
    remedy: str = ""
    """What to do; empty where nothing is to be done."""
    sure: Sureness = "certain"
    """Certain: it follows from the file; likely: other causes are rare; possible: have a look."""
    fault: str = ""
    """A short name of the kind of fault, the same in every version; empty where all is well."""

    def __str__(self) -> str:
        """The finding in one line, without subject and state."""
        sure = "" if self.state == "good" or self.sure == "certain" else f" ({self.sure})"
        return f"{self.text}{sure}{self.remedy and f'. {self.remedy}'}"

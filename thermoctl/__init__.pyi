from thermoctl.api import Diagnosis as Diagnosis
from thermoctl.api import Finding as Finding
from thermoctl.api import Plant as Plant
from thermoctl.api import Refit as Refit
from thermoctl.api import Simulation as Simulation
from thermoctl.api import check as check
from thermoctl.api import diagnose as diagnose
from thermoctl.api import load_plant as load_plant
from thermoctl.api import read as read
from thermoctl.api import refit as refit
from thermoctl.api import simulate as simulate

__version__: str

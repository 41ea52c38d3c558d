"""The first lines of a program that needs `Preemption` alone, and imports no JAX."""

from jetbot_mjx.training import preemption

LISTENER = f"""
import hashlib, importlib.util, os, signal, time
# A test run that `nohup` started ignores SIGHUP, and so would its children.
signal.signal(signal.SIGHUP, signal.SIG_DFL)
spec = importlib.util.spec_from_file_location("preemption", {preemption.__file__!r})
preemption = importlib.util.module_from_spec(spec)
spec.loader.exec_module(preemption)

def send(number=signal.SIGTERM):
    os.kill(os.getpid(), number)

"""

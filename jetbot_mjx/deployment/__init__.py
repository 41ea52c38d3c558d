"""Take a policy out of JAX: exporters, a simulated JetBot, logs of real drives."""

from typing import TYPE_CHECKING

from jetbot_mjx.imports import load_lazily

if TYPE_CHECKING:
    from jetbot_mjx.deployment.drive_comparison import compare_drive as compare_drive
    from jetbot_mjx.deployment.policy_export import export_policy as export_policy

__getattr__, __dir__ = load_lazily(__name__)

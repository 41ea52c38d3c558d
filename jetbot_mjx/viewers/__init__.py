"""Show a policy: as a video, on a page in the browser, in MuJoCo's window."""

from typing import TYPE_CHECKING

from jetbot_mjx.imports import load_lazily

if TYPE_CHECKING:
    from jetbot_mjx.viewers.gallery import Rendered as Rendered
    from jetbot_mjx.viewers.gallery import render_gallery as render_gallery
    from jetbot_mjx.viewers.gallery import render_run as render_run
    from jetbot_mjx.viewers.live import play_live as play_live
    from jetbot_mjx.viewers.many import render_many as render_many
    from jetbot_mjx.viewers.many import render_training_strip as render_training_strip
    from jetbot_mjx.viewers.player import Player as Player

__getattr__, __dir__ = load_lazily(__name__)

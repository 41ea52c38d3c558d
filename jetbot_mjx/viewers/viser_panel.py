"""Build the control panel of a player's page in viser."""

import math
from collections.abc import Callable
from typing import Literal

import jinja2
import viser

from jetbot_mjx.errors import UserError, shown
from jetbot_mjx.viewers.player import SPEEDS, Player
from jetbot_mjx.viewers.step_fns import AGENTS, KEYBOARD
from jetbot_mjx.viewers.viser_camera import CAMERAS
from jetbot_mjx.viewers.viser_policy_view import PolicyView
from jetbot_mjx.viewers.viser_recorder import Recorder
from jetbot_mjx.viewers.viser_scene import Scene

_BUTTONS = ("Step", "New episode")

_PAGES = jinja2.Environment(
    loader=jinja2.PackageLoader("jetbot_mjx", "assets"), autoescape=True, trim_blocks=True
)


class ControlPanel:
    """A `ControlPanel` holds the controls of the page; all clients share one panel."""

    def __init__(
        self, server: viser.ViserServer, player: Player, scene: Scene, ask: Callable[..., None]
    ) -> None:
        """Build the panel.

        Args:
          server: the viser server.
          player: the player.
          scene: the scene of the page.
          ask: a function that queues a call for the player's thread, since viser calls back from
            its own threads.
        """
        self._server, self._player, self._scene, self._ask = server, player, scene, ask
        gui = server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(60, 105, 0))
        labels = player.describe()
        self.texts = {label: gui.add_text(label, "", disabled=True) for label in labels}
        self.policy_view = PolicyView(gui, player) if player.sees else None
        self._bars = _PAGES.get_template("rewards.html")
        self._largest = dict.fromkeys(player.snapshot.rewards, 1e-9)
        self.rewards = gui.add_html("")
        self._add_choices()
        self._add_drive_controls()
        gui.add_markdown(
            player.cannot_move_goal
            or "Click on the floor, or drag the cube, to move the goal. This restarts its time"
            " limit."
        )
        self._switch_agent()
        self.update()

    def update(self) -> None:
        """Show the present values of the player."""
        player = self._player
        for label, text in player.describe().items():
            self.texts[label].value = text
        self.rewards.content = self._reward_bars()
        # Do not assign equal values: the page would rebuild the control.
        checkpoints = _labels(player)
        if checkpoints != self.checkpoint.options:
            self.checkpoint.options = checkpoints
        if player.robots > 1 and self.robot.value != player.robot:
            self.robot.value = player.robot
        buttons = ("Resume" if player.paused else "Pause", *_BUTTONS)
        if buttons != self.buttons.options:
            self.buttons.options = buttons

    def _reward_bars(self) -> str:
        """Return a bar for each term of the reward, relative to the largest value it has had."""
        snapshot = self._player.snapshot
        for name, reward in snapshot.rewards.items():
            self._largest[name] = max(self._largest[name], abs(float(reward)))
        return self._bars.render(
            rewards=snapshot.rewards, returns=snapshot.returns, largest=self._largest
        )

    def _add_choices(self) -> None:
        gui, player = self._server.gui, self._player
        if player.robots > 1:
            self.robot = robot = gui.add_slider("Robot", 0, player.robots - 1, 1, player.robot)
            robot.on_update(lambda _: self._ask(self._slide, "robot", robot))
        self.agent = gui.add_dropdown("Agent", AGENTS, initial_value=player.agent)
        self.checkpoint = gui.add_dropdown(
            "Checkpoint", _labels(player), initial_value=_label(player.checkpoint)
        )
        self.buttons = gui.add_button_group("", ("Pause", *_BUTTONS))
        self.speed = speed = gui.add_slider("Speed ×", *SPEEDS, 0.1, player.speed)
        self.camera = camera = gui.add_dropdown(
            "Camera", CAMERAS, initial_value=self._scene.cameras.mode
        )
        shadows = gui.add_checkbox("Shadows", False)
        self.recorder = Recorder(gui)
        self.agent.on_update(lambda _: self._ask(self._switch_agent))
        self.checkpoint.on_update(lambda _: self._ask(self._switch_checkpoint))
        self.buttons.on_click(lambda event: self._ask(self._press, event.target.value))
        speed.on_update(lambda _: self._ask(self._slide, "speed", speed))
        camera.on_update(lambda _: self._ask(setattr, self._scene.cameras, "mode", camera.value))
        shadows.on_update(lambda _: self._ask(self._scene.cast_shadows, shadows.value))

    def _add_drive_controls(self) -> None:
        """Add the controls of the agent `keyboard`: two sliders, and keys that move them."""
        gui, player, limits = self._server.gui, self._player, self._player.env.config.task
        fastest = math.ceil(math.degrees(limits.max_yaw_rate))
        self.drive_controls = gui.add_folder("Drive")
        with self.drive_controls:
            self.ahead = ahead = gui.add_slider("Ahead m/s", 0.0, limits.max_speed, 0.01, 0.0)
            self.left = left = gui.add_slider("Left °/s", -fastest, fastest, 1, 0)
            gui.add_markdown(
                "Keys: I faster, K slower, J left, L right, H stop. A command holds until the next"
                " key press."
            )

        def follow_sliders() -> None:
            player.drive(_within(ahead), math.radians(_within(left)))

        def press(do: Callable[..., None], *given: int) -> None:
            do(*given)
            # Setting a slider rounds the value and calls `follow_sliders`.
            ahead.value, left.value = player.command[0], round(math.degrees(player.command[1]))

        for slider in (ahead, left):
            slider.on_update(lambda _: self._ask(follow_sliders))
        self._keys = [
            self._add_key("I", "faster", press, player.nudge, 1, 0),
            self._add_key("K", "slower", press, player.nudge, -1, 0),
            self._add_key("J", "left", press, player.nudge, 0, 1),
            self._add_key("L", "right", press, player.nudge, 0, -1),
            self._add_key("H", "stop", press, player.drive, 0, 0),
        ]

    def _add_key(
        self, key: Literal["I", "J", "K", "L", "H"], label: str, *press: Callable[..., None] | int
    ) -> viser.CommandHandle:
        command = self._server.gui.add_command(f"Drive: {label}", hotkey=key)
        command.on_trigger(lambda _: self._ask(*press))
        return command

    def _slide(self, name: str, slider: viser.GuiSliderHandle) -> None:
        setattr(self._player, name, _within(slider))

    def _switch_agent(self) -> None:
        if self.agent.value not in AGENTS:
            raise ValueError(f"{shown(self.agent.value)} is no agent")
        self._player.agent = self.agent.value
        is_keyboard = self.agent.value == KEYBOARD
        # Show the sliders last: once a page has them, its keys work.
        for command in self._keys:
            command.disabled = not is_keyboard
        self.drive_controls.visible = is_keyboard

    def _switch_checkpoint(self) -> None:
        wanted = int(self.checkpoint.value.partition(" ")[0].replace(",", ""))
        if wanted == self._player.checkpoint:
            return
        try:
            self._player.switch_checkpoint(wanted)
        except UserError as error:
            self.checkpoint.value = _label(self._player.checkpoint)
            for client in self._server.get_clients().values():
                client.add_notification("Not switched", str(error), color="red")

    def _press(self, button: str) -> None:
        match button:
            case "Step":
                self._player.paused = True
                self._player.tick()
            case "New episode":
                self._player.reset()
            case _:
                self._player.paused = not self._player.paused


def _within(slider: viser.GuiSliderHandle) -> float:
    """Return the value of a slider, which a page could set to any.

    Raises:
      ValueError: it is out of bounds.
    """
    if not slider.min <= slider.value <= slider.max:
        raise ValueError(f"{shown(slider.value)} is not from {slider.min} to {slider.max}")
    return slider.value


def _label(env_steps: int) -> str:
    return f"{env_steps:,} steps"


def _labels(player: Player) -> tuple[str, ...]:
    return tuple(_label(steps) for steps in player.checkpoints)

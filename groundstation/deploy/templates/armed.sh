# Prints what the agent on this board does, if it runs and is not disarmed; "unknown" if it runs and does not say.
# The file is written by robot_agent/host/sd_notify.py: a mode's name, and the agent's process number.
armed() {
    status=${RUNTIME_DIRECTORY:-/run/shoal-agent}/status
    if [ -r "$status" ] && read -r mode process <"$status"; then
        [ "$mode" = DISARMED ] || [ ! -d "/proc/$process" ] || echo "$mode"
    elif [ "$(systemctl is-active shoal-agent.service 2>/dev/null)" = active ]; then
        echo unknown
    fi
}

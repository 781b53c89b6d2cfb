# Completion of lathe for zsh. No blank follows a node or a parameter: its name or value is yet to be typed.
if ! (( $+functions[compdef] )); then autoload -Uz compinit && compinit; fi
_lathe_complete() {
    local -a described plain open answer
    local kind value about
    answer=("${(@f)$(COMP_WORDS="${words[*]}" COMP_CWORD=$((CURRENT-1)) _LATHE_COMPLETE=zsh_complete \
        ${~words[1]} 2>/dev/null)}")
    for kind value about in $answer; do
        case $kind in
            dir) _path_files -/ ;;
            file) _path_files -f ;;
            plain)
                if [[ $value == *[.=] ]]; then open+=($value)
                elif [[ $about == _ ]]; then plain+=($value)
                else described+=("${value//:/\\:}:$about"); fi ;;
        esac
    done
    (( $#described )) && _describe -V lathe described -U
    (( $#plain )) && compadd -U -V lathe -a plain
    (( $#open )) && compadd -U -S '' -V lathe -a open
    return 0
}
compdef _lathe_complete lathe
